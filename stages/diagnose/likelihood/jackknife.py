"""Errors and intervals by leaving out one piece of ground after the other (Efron & Tibshirani 1993, ch. 11)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

FRACTION = 0.95


def jackknife_error(without: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error of a statistic, given its values with one unit left out each, (U, ...)."""
    units = len(without)
    if units < 2:
        return np.full(without.shape[1:], math.inf)
    return np.sqrt((units - 1) / units * ((without - without.mean(0)) ** 2).sum(0))


def gain_interval(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[float, float, float]:
    """Percent by which sums of squares per unit (U,) get smaller in total, and the 95 % interval of that by Student's t."""
    total = float(before.sum())
    if len(before) < 3 or not total > 0:
        return math.nan, math.nan, math.nan
    gain = 100 * (1 - float(after.sum()) / total)
    without = 100 * (1 - (after.sum() - after) / np.maximum(total - before, 1e-30))
    half = float(student.ppf(0.5 + FRACTION / 2, len(before) - 1)) * float(jackknife_error(without))
    return gain, gain - half, gain + half


__all__ = ["gain_interval", "jackknife_error"]
