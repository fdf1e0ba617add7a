"""Errors and intervals by leaving out one piece of ground after the other (Efron & Tibshirani 1993, ch. 11)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.common.intervals import student_quantile
from stages.diagnose.likelihood.tails import student_tail
from stages.diagnose.likelihood.typical import typical_bounds
from stages.diagnose.settings import FOLDS


def folds(count: int) -> NDArray[np.int64]:
    """(count,) of so many pieces of ground, the numbers of those that are left out together.

    In no order: every eighth piece may be one that the same images show, and their own values would be known from no other ground.
    """
    return np.random.default_rng(count).permutation(count) % FOLDS


def jackknife_error(without: NDArray[np.float64], left: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Standard error of a statistic, given its values with one unit left out each, (U, ...).

    left : likewise, the information that is left without each (Hinkley 1977, Technometrics 19, 285); alike where None
    """
    units = len(without)
    if units < 2:
        return np.full(without.shape[1:], math.inf)
    left = np.ones_like(without) if left is None else left
    share = left / np.maximum(left.sum(0), 1e-300)
    apart = without - (share * without).sum(0)
    kept = np.minimum((units - 1) * share, 1.0)  # of the whole
    return np.sqrt(units / (units - 1) * ((kept * apart) ** 2).sum(0))


def gain_interval(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[float, float, float]:
    """Percent by which sums of squares per unit (U,) get smaller in total, and the 95 % interval of that."""
    total = float(before.sum())
    if len(before) < 3 or not total > 0:
        return math.nan, math.nan, math.nan
    gain, error = _gain(before, after)
    if bounds := typical_bounds(before - after, before):
        return gain, 100 * bounds[0], 100 * bounds[1]
    half = student_quantile(len(before) - 1) * error
    return gain, gain - half, gain + half


def gain_chance(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """One-sided chance of such a gain where there is none, by Student's t over the units (U,)."""
    if len(before) < 3 or not float(before.sum()) > 0:
        return math.nan
    gain, error = _gain(before, after)
    return student_tail(gain / max(error, 1e-30), len(before) - 1)


def _gain(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[float, float]:
    """Percent by which sums of squares get smaller, and its standard error."""
    total = float(before.sum())
    without = 100 * (1 - (after.sum() - after) / np.maximum(total - before, 1e-30))
    return 100 * (1 - float(after.sum()) / total), float(jackknife_error(without))


def nats(before: float, after: float, pixels: float, per_sample: float) -> float:
    """Log likelihood that a smaller sum of squares gains, with one independent sample in so many pixels."""
    return 0.5 * pixels / per_sample * math.log(before / after) if before > 0 and after > 0 else math.nan


__all__ = ["gain_chance", "gain_interval", "jackknife_error", "nats"]
