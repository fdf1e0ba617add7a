"""How far an image that had no part in the albedo lies from the map: half-widths of intervals that hold so often.

Errors of photographs have long tails, so that one standard deviation cannot serve for both 68 and 95 %: each width is a
quantile of residuals of images left out in turn, in units of the predicted standard deviation and by cos(incidence); in
shadow, where the map has nothing to multiply, in units of the sine of the Sun's elevation. Residuals of one image share
errors (its gain, the angles that only it has), and a scene has few images: all widths are multiplied by what makes them
hold for each image when they come from the others alone (cross-conformal prediction by units: Vovk 2015, Ann. Math. Artif.
Intell. 74:9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats, Floats32
from stages.common.intervals import unseen_factors
from stages.photographs.posterior import Spread, estimate, robust_mean
from stages.physics.images.references import Observed

SHARES = (0.6827, 0.95)
GAUSSIAN = (1.0, 1.96)  # where nothing can be left out
THINNED = 5  # every so manyth pixel: neighbours say the same
TURNS = 3  # images of a window that are left out in turn
LEAST_PX = 1000  # of a bin, else it takes what its neighbours have
LEAST_IMAGES = 3  # the same


@dataclass(frozen=True)
class Stack:
    """A window: log ratios and confidence (n, H, W) of ``images``, their observations, what each is in I/F (NaN unknown), and the
    prior of ``posterior.estimate``.
    """

    ratio: Floats32
    confidence: Floats32
    images: list[int]
    observations: Sequence[Observed]
    measured: Sequence[Floats32]
    prior: Floats32 | None


def unseen_intervals(stacks: Sequence[Stack], spread: Spread, edges: Floats) -> tuple[Floats, Floats]:
    """(2, bins) half-widths over hypot(std of the albedo, median image's own), by bins of cos(incidence) ``edges``; (2,)
    in shadow, over the sine of the Sun's elevation.
    """
    bins = len(edges) - 1
    residuals, places, images = _residuals(stacks, spread, edges)
    lit = places < bins
    result, shadow = np.tile(np.array(GAUSSIAN)[:, None], bins), np.zeros(2)
    if lit.any():
        result = unseen_widths(residuals[lit], places[lit], images[lit], bins)
        if not lit.all():
            shadow = unseen_widths(residuals[~lit], places[~lit] - bins, images[~lit], 1)[:, 0]
    return result, shadow


def unseen_widths(residual: Floats32, place: NDArray[np.intp], image: NDArray[np.intp], bins: int) -> Floats:
    """(2, bins) half-widths that hold for an image that is not among these, on the average over such images.

    residual : (N,) absolute; place, image : (N,) bins and images of them
    """
    factors = unseen_factors(
        residual,
        image,
        lambda own: _widths(residual[~own], place[~own], image[~own], bins)[:, place[own]],
        SHARES,
    )
    return _widths(residual, place, image, bins) * factors[:, None]


def _widths(residual: Floats32, place: NDArray[np.intp], image: NDArray[np.intp], bins: int) -> Floats:
    """(2, bins) quantiles of residuals, those of the neighbours where a bin has too few; arguments as above."""
    result = np.tile(np.quantile(residual.astype(float), SHARES)[:, None], bins)
    enough = [k for k in range(bins) if _is_enough(image[place == k])]
    if enough:
        quantiles = [np.quantile(residual[place == k], SHARES) for k in enough]
        result = np.stack([np.interp(range(bins), enough, level) for level in np.transpose(quantiles)])
    return result


def _is_enough(image: NDArray[np.intp]) -> bool:
    return len(image) >= LEAST_PX and len(np.unique(image)) >= LEAST_IMAGES


def _residuals(
    stacks: Sequence[Stack], spread: Spread, edges: Floats
) -> tuple[Floats32, NDArray[np.intp], NDArray[np.intp]]:
    """Of images left out in turn: residuals in units of what they are counted in, bins (the last: shadow), images; (N,)."""
    own = np.float32(np.median(spread.own.sum(axis=1)))
    found: list[tuple[Floats32, NDArray[np.intp], NDArray[np.intp]]] = []
    turn = 0
    for stack in stacks:
        count = len(stack.images)
        for _ in range(min(TURNS, count) if count > 1 else 0):
            out, turn = turn % count, turn + 1
            others = [k for k in range(count) if k != out]
            rest, trust = stack.ratio[others], stack.confidence[others]
            part = spread.of([stack.images[k] for k in others])
            robust_mean(rest, trust, part)
            location, std = estimate(rest, trust, part, stack.prior)
            observed, seen = stack.observations[out], (stack.confidence[others] > 0).any(axis=0)
            known = np.isfinite(stack.measured[out]) & (observed.shadow | (seen & (observed.predicted > 0)))
            use = np.flatnonzero(known)[::THINNED]
            predicted = (observed.predicted * np.exp(location)).ravel()[use]
            shadow, unit = observed.shadow.ravel()[use], np.sqrt(std.ravel()[use] ** 2 + own) * predicted
            unit = np.where(shadow, np.float32(max(observed.sun_sine, 1e-3)), unit)
            place = np.clip(np.digitize(observed.cos_incidence.ravel()[use], edges) - 1, 0, len(edges) - 2)
            residual = (np.abs(stack.measured[out].ravel()[use] - predicted) / unit).astype(np.float32)
            found.append(
                (residual, np.where(shadow, len(edges) - 1, place), np.full(len(use), stack.images[out], np.intp))
            )
    if not found:
        return np.zeros(0, np.float32), np.zeros(0, np.intp), np.zeros(0, np.intp)
    residuals, places, images = (np.concatenate([f[k] for f in found]) for k in range(3))
    return residuals, places, images
