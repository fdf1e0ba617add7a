"""How far an image that had no part in the albedo lies from the map: half-widths of intervals that hold so often.

Errors of photographs have long tails, so that one standard deviation cannot serve for both 68 and 95 %: each width is a
quantile of residuals of images left out in turn (conformal prediction by splitting: Papadopoulos et al. 2002, ECML:345),
in units of the predicted standard deviation and by cos(incidence); in shadow, where the map has nothing to multiply, in
units of the sine of the Sun's elevation. Residuals of one image share errors (its gain, the angles that only it has), and a
scene has few images: the part of the variance that lies between images takes the factor of a prediction interval from so
many of them (Student's t, Hahn & Meeker 1991, "Statistical Intervals", ch. 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from stages.albedo.posterior import Spread, estimate, settle
from stages.albedo.references import Look
from stages.common.arrays import Floats, Floats32

SHARES = (0.6827, 0.95)
GAUSSIAN = (1.0, 1.96)  # where nothing can be left out
THINNED = 5  # every so manyth pixel: neighbours say the same
TURNS = 3  # images of a window that are left out in turn
LEAST_PX = 1000  # of a bin, else it takes what its neighbours have
LEAST_IMAGES = 3  # the same


@dataclass(frozen=True)
class Stack:
    """A window: log ratios and confidence (n, H, W) of ``images``, their looks, what each is in I/F (NaN unknown), and the
    prior of ``posterior.estimate``.
    """

    ratio: Floats32
    confidence: Floats32
    images: list[int]
    looks: Sequence[Look]
    measured: Sequence[Floats32]
    prior: Floats32 | None


def unseen_intervals(stacks: Sequence[Stack], spread: Spread, edges: Floats) -> tuple[Floats, Floats]:
    """(2, bins) half-widths over hypot(std of the albedo, median image's own), by bins of cos(incidence) ``edges``; (2,)
    in shadow, over the sine of the Sun's elevation.
    """
    bins = len(edges) - 1
    residuals, places, images = _residuals(stacks, spread, edges)
    result, shadow = np.tile(np.array(GAUSSIAN)[:, None], bins), np.zeros(2)
    lit = places < bins
    if not lit.any():
        return result, shadow
    allowance = _allowance(residuals[lit], images[lit])
    result[:] = (_quantiles(residuals[lit]) * allowance)[:, None]
    enough = [
        k
        for k in range(bins)
        if (places == k).sum() >= LEAST_PX and len(np.unique(images[places == k])) >= LEAST_IMAGES
    ]
    if enough:
        middles = 0.5 * (edges[1:] + edges[:-1])
        widths = [_quantiles(residuals[places == k]) * allowance for k in enough]
        result = np.stack([np.interp(middles, middles[enough], level) for level in np.transpose(widths)])
    if not lit.all():
        shadow = _quantiles(residuals[~lit]) * allowance
    return result, shadow


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
            settle(rest, trust, part)
            location, std = estimate(rest, trust, part, stack.prior)
            look, seen = stack.looks[out], (stack.confidence[others] > 0).any(axis=0)
            known = np.isfinite(stack.measured[out]) & (look.shadow | (seen & (look.predicted > 0)))
            use = np.flatnonzero(known)[::THINNED]
            predicted = (look.predicted * np.exp(location)).ravel()[use]
            shadow, unit = look.shadow.ravel()[use], np.sqrt(std.ravel()[use] ** 2 + own) * predicted
            unit = np.where(shadow, np.float32(max(look.sun_sine, 1e-3)), unit)
            place = np.clip(np.digitize(look.cos_incidence.ravel()[use], edges) - 1, 0, len(edges) - 2)
            residual = ((stack.measured[out].ravel()[use] - predicted) / unit).astype(np.float32)
            found.append(
                (residual, np.where(shadow, len(edges) - 1, place), np.full(len(use), stack.images[out], np.intp))
            )
    if not found:
        return np.zeros(0, np.float32), np.zeros(0, np.intp), np.zeros(0, np.intp)
    residuals, places, images = (np.concatenate([f[k] for f in found]) for k in range(3))
    return residuals, places, images


def _quantiles(residual: Floats32) -> Floats:
    return np.quantile(np.abs(residual), SHARES)


def _allowance(residual: Floats32, image: NDArray[np.intp]) -> Floats:
    """(2,) factors on quantiles for an image that is not among those seen."""
    names, counts = np.unique(image, return_counts=True)
    images = counts.sum() ** 2 / np.square(counts).sum()  # as many equal ones as these unequal ones count for (Kish)
    if images < 2:
        return np.ones(2)
    middles = np.array([np.median(residual[image == k]) for k in names])
    between = np.average(middles**2, weights=counts) / _quantiles(residual)[0] ** 2
    tail = np.array([0.5 + share / 2 for share in SHARES])
    student = stdtrit(images - 1, tail) * np.sqrt(1 + 1 / images) / ndtri(tail)
    return np.sqrt(1 + min(1.0, float(between)) * (student**2 - 1))
