"""A pattern that stays on the detector whatever ground it shows, as dust on a window, a flat field that is off or pixels of their own make it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.common.intervals import student_quantile
from stages.diagnose.likelihood.jackknife import jackknife_error
from stages.diagnose.structure.innovations import Innovation

BLOCK = 32  # px of the detector, beyond which neither ground nor pattern is alike by chance
FEWEST = 4  # blocks


def pattern_of_detector(every: Sequence[Innovation]) -> tuple[float, float]:
    """Share of the squares that images of different ground have alike where they fall on the same pixel of the detector, and its
    lower bound (95 %). Ground has none of that, and of a line camera only images that lie on the same lines have it.
    """
    place, value, site = _on_pixels(every)
    if not len(place):
        return 0.0, 0.0
    first = place.min(0)
    wide = int(place[:, 1].max() - first[1]) + 1
    number, pixel = np.unique(
        (place - first) @ [wide, 1], return_inverse=True
    )  # of every pixel that is hit, row by row
    total, count = np.bincount(pixel, value), np.bincount(pixel)
    _, block = np.unique(number // wide // BLOCK * wide + number % wide // BLOCK, return_inverse=True)
    alike, squares = np.zeros((2, int(block.max()) + 1))
    for s in np.unique(site):
        here = site == s
        own, often, power = (np.bincount(pixel[here], w, len(number)) for w in (value[here], None, value[here] ** 2))
        both = (often > 0) & (count > often)
        alike += np.bincount(block[both], (own * (total - own))[both] / (count - often)[both], len(alike))
        squares += np.bincount(block[both], power[both], len(alike))
    alike, squares = alike[squares > 0], squares[squares > 0]
    if len(squares) < FEWEST:
        return 0.0, 0.0
    share = float(alike.sum() / squares.sum())
    without = (alike.sum() - alike) / (squares.sum() - squares)
    return share, share - student_quantile(len(squares) - 1) * float(jackknife_error(without, squares.sum() - squares))


def _on_pixels(every: Sequence[Innovation]) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """(N, 2) line and sample, (N,) value and (N,) number of the ground of every pixel that is seen."""
    place, value, site = [np.zeros((0, 2), np.int64)], [np.zeros(0)], [np.zeros(0, np.int64)]
    for one in every:
        known = one.seen & one.detector.isfinite().all(1)
        place.append(np.stack([x[known].round().long().numpy() for x in one.detector.unbind(1)], 1))
        value.append(one.limited[known].double().numpy())
        site.append(np.full(len(value[-1]), one.patch.site))
    return np.concatenate(place), np.concatenate(value), np.concatenate(site)


__all__ = ["pattern_of_detector"]
