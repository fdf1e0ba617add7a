"""Odd and even columns, or lines, of a detector that differ, as two amplifiers or two fields of a picture leave them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.diagnose.likelihood.jackknife import jackknife_error
from stages.diagnose.structure.innovations import Innovation

BLOCK = 8  # columns, which share what a flat field has of its own in each
FEWEST = 8  # blocks


def odd_and_even(every: Sequence[Innovation]) -> tuple[float, float]:
    """How many standard errors (over columns of the detector) the alternating part of what is left is from nothing, and its share of the squares."""
    best = 0.0, 0.0
    for axis in (0, 1):
        on, weight, squares = _alternating(every, axis)
        if len(on) < FEWEST:
            continue
        amount = float(on.sum() / weight.sum())
        without = (on.sum() - on) / (weight.sum() - weight)
        error = float(jackknife_error(without, weight.sum() - weight))
        best = max(best, (abs(amount) / max(error, 1e-12), amount**2 * float(weight.sum()) / squares))
    return best


def _alternating(every: Sequence[Innovation], axis: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Of every block of columns what is left times cos(pi column), and the squares of the latter; all squares of what is left.

    Halfway between two columns a pixel tells of neither.
    """
    place, on, weight, squares = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)], 0.0
    for one in every:
        column = one.detector[:, axis]
        known = one.seen & column.isfinite()
        at, value = column[known].double().numpy(), one.limited[known].double().numpy()
        turn = np.cos(math.pi * at)
        place.append((at // BLOCK).astype(np.int64))
        on.append(value * turn)
        weight.append(turn**2)
        squares += float((value**2).sum())
    _, block = np.unique(np.concatenate(place), return_inverse=True)
    sums = [np.bincount(block, np.concatenate(x)).astype(np.float64) for x in (on, weight)]
    return sums[0], sums[1], max(squares, 1e-9)


__all__ = ["odd_and_even"]
