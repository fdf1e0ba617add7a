"""A pattern that stays on the detector whatever ground it shows, as dust on a window, a flat field that is off or pixels of their own make it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.common.arrays import Floats
from stages.common.intervals import student_quantile
from stages.diagnose.likelihood.jackknife import alike_half_width, jackknife_error
from stages.diagnose.structure.innovations import Innovation
from stages.effects.filters import blur_matrix

BLOCK = 32  # px of the detector, beyond which neither ground nor pattern is alike by chance
FEWEST = 4  # blocks
SPOT = 1.0  # px, sigma: dust is broader, noise of single pixels is not
KNOWN = 0.2  # of the weight about a pixel, which it is a mean of at least
PASSES = 3  # of taking out means of columns and lines in turn, where a block is not full


def pattern_of_detector(every: Sequence[Innovation], spots: bool = False) -> tuple[float, float]:
    """Share of the squares that images of different ground have alike where they fall on the same pixel of the detector, and its
    lower bound (95 %). Ground has none of that, and of a line camera only images that lie on the same lines have it.

    spots : of what is broader than a pixel, beside what whole columns and lines have, which is a matter of the flat field
    """
    place, value, site = _on_pixels(every, spots)
    if not len(place):
        return 0.0, 0.0
    first = place.min(0)
    wide = int(place[:, 1].max() - first[1]) + 1
    number, pixel = np.unique(
        (place - first) @ [wide, 1], return_inverse=True
    )  # of every pixel that is hit, row by row
    line, sample = number // wide, number % wide
    _, block = np.unique(line // BLOCK * wide + sample // BLOCK, return_inverse=True)
    along = [block * BLOCK + at % BLOCK for at in (line, sample)] if spots else []
    total, count = np.bincount(pixel, value), np.bincount(pixel)
    alike, squares = np.zeros((2, int(block.max()) + 1))
    grounds: list[tuple[float, float]] = []
    for s in np.unique(site):
        here = site == s
        own, often, power = (np.bincount(pixel[here], w, len(number)) for w in (value[here], None, value[here] ** 2))
        both = (often > 0) & (count > often)
        mean, other = (
            _without(np.where(both, x / np.maximum(n, 1), 0.0), both, along)
            for x, n in ((own, often), (total - own, count - often))
        )
        alike += np.bincount(block, often * mean * other, len(alike))
        squares += np.bincount(block[both], power[both], len(alike))
        grounds.append((float((often * mean * other).sum()), float(power[both].sum())))
    alike, squares = alike[squares > 0], squares[squares > 0]
    of_ground, all_of_ground = np.array([g for g in grounds if g[1] > 0]).reshape(-1, 2).T
    if len(squares) < FEWEST or len(all_of_ground) < 3:
        return 0.0, 0.0
    share = float(alike.sum() / squares.sum())
    without = (alike.sum() - alike) / (squares.sum() - squares)
    error = student_quantile(len(squares) - 1) * float(jackknife_error(without, squares.sum() - squares))
    # two grounds that look alike by chance do so over many blocks
    return share, share - max(error, alike_half_width(of_ground, all_of_ground))


def _without(x: Floats, known: NDArray[np.bool_], along: Sequence[NDArray[np.int64]]) -> Floats:
    """(N,) pixels, 0 where not known, less the means of those with the same number in each of ``along``."""
    for _ in range(PASSES if along else 0):
        for key in along:
            x = x - known * (np.bincount(key, x) / np.maximum(np.bincount(key, known), 1))[key]
    return x


def _on_pixels(
    every: Sequence[Innovation], smooth: bool
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """(N, 2) line and sample, (N,) value and (N,) number of the ground of every pixel that is seen."""
    place, value, site = [np.zeros((0, 2), np.int64)], [np.zeros(0)], [np.zeros(0, np.int64)]
    for one in every:
        known = one.seen & one.detector.isfinite().all(1)
        place.append(np.stack([x[known].round().long().numpy() for x in one.detector.unbind(1)], 1))
        value.append((_smooth(one) if smooth else one.limited)[known].double().numpy())
        site.append(np.full(len(value[-1]), one.patch.site))
    return np.concatenate(place), np.concatenate(value), np.concatenate(site)


def _smooth(one: Innovation) -> Tensor:
    """(n, h, w) means of what is seen about each pixel."""
    down, across = (blur_matrix(count, SPOT).to(one.value.dtype) for count in one.value.shape[-2:])
    known = down @ one.seen.to(one.value.dtype) @ across.T
    mean: Tensor = down @ torch.where(one.seen, one.limited, 0.0) @ across.T / known.clamp(min=KNOWN)
    return mean


__all__ = ["pattern_of_detector"]
