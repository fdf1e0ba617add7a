"""How far an image that had no part in the albedo lies from the map: half-widths of intervals that hold so often.

Errors of photographs have long tails, so that one standard deviation cannot serve for both 68 and 95 %: each width is a
quantile of residuals of images left out in turn (conformal prediction by splitting: Papadopoulos et al. 2002, ECML:345),
in units of the predicted standard deviation and by cos(incidence).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.albedo.posterior import Spread, estimate, settle

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Stack = tuple[Floats32, Floats32, list[int], list[Floats32]]  # log ratios, confidence (n, H, W), images, cos(incidence)

SHARES = (0.6827, 0.95)
GAUSSIAN = (1.0, 1.96)  # where nothing can be left out
THINNED = 5  # every so manyth pixel: neighbours say the same
LEAST_PX = 2000  # of a bin, else it takes what its neighbours have


def unseen_intervals(stacks: Sequence[Stack], spread: Spread, log_gain: Floats, edges: Floats) -> Floats:
    """(2, bins) half-widths over hypot(std of the albedo, median image's own), by bins of cos(incidence) ``edges``.

    log_gain : (n,) by which each image is brighter than the map, which nobody knows of an unseen one
    """
    own = np.float32(np.median(spread.own.sum(axis=1)))
    found: list[Floats32] = []
    bins: list[NDArray[np.intp]] = []
    turn = 0
    for ratio, confidence, images, cosines in stacks:
        if len(images) < 2:
            continue
        out, turn = turn % len(images), turn + 1
        others = [k for k in range(len(images)) if k != out]
        rest, trust = ratio[others], confidence[others]
        part = spread.of([images[k] for k in others])
        settle(rest, trust, part)
        location, std = estimate(rest, trust, part)
        use = np.flatnonzero((confidence[out] > 0) & (confidence[others] > 0).any(axis=0))[::THINNED]
        away = np.expm1(ratio[out].ravel()[use] + np.float32(log_gain[images[out]]) - location.ravel()[use])
        found.append(np.abs(away) / np.sqrt(std.ravel()[use] ** 2 + own))
        bins.append(np.clip(np.digitize(cosines[out].ravel()[use], edges) - 1, 0, len(edges) - 2))
    result = np.tile(np.array(GAUSSIAN)[:, None], len(edges) - 1)
    if not found or sum(len(f) for f in found) == 0:
        return result
    size, place = np.concatenate(found), np.concatenate(bins)
    result[:] = np.quantile(size, SHARES)[:, None]
    middles = 0.5 * (edges[1:] + edges[:-1])
    enough = [b for b in range(len(middles)) if (place == b).sum() >= LEAST_PX]
    if enough:
        widths = np.array([np.quantile(size[place == b], SHARES) for b in enough])
        for k in range(2):
            result[k] = np.interp(middles, middles[enough], widths[:, k])
    return result
