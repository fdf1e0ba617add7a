"""95 % intervals over ground: delete-one-unit jackknife of ratios with Student's t, and the spread over training runs.

Pairs on one ground tile share terrain and images, so tiles and not pairs are the independent witnesses. All that is
compared is a ratio of sums over tiles: a mean squared error (squared errors over pixels), a gain (errors of one model
over those of another, paired tile by tile), a share of matches (hits over matches). With the ratio R of all units and
R_k of all but unit k, on a scale f (logarithm for positive ratios, whose errors are skewed; logit for shares):

    variance = (n - 1)/n sum (f(R_k) - f(R))^2                                       Tukey (1958), Ann. Math. Stat. 29, 614

Units of unequal weight w count as (sum w)^2 / sum w^2 equal ones (Kish 1965, Survey Sampling, 11.7), less one for the
degrees of freedom of t. Several training runs add the variance of their mean; degrees of freedom are joined after
Satterthwaite (1946), Biometrics Bull. 2, 110. `tests/test_intervals.py` simulates how often such intervals hold the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

LEVEL = 0.95
FEWEST_UNITS = 4  # coverage is tested from here on


@dataclass(frozen=True)
class Variance:
    """A variance and the degrees of freedom with which it is known."""

    value: float
    freedom: float


@dataclass(frozen=True)
class Interval:
    """An estimate and the bounds of its 95 % interval; NaN where there is no spread to judge by."""

    value: float
    low: float
    high: float


def choose_units(tile: NDArray, site: NDArray) -> tuple[NDArray, str]:
    """Labels of the independent pieces of ground, (N,), and their name: tiles, or the sites of a single tile."""
    return (tile, "tile") if len(np.unique(tile)) > 1 else (site, "site")


def ratio_interval(total: NDArray, weight: NDArray, unit: NDArray, scale: str = "log") -> Interval:
    """sum(total) / sum(weight) with its 95 % interval over ground and training runs.

    total : (N,) or (runs, N); weight : likewise, or (N,) for all runs; unit : (N,) labels of pieces of ground. Entries
    that are not finite do not count.
    scale : 'log' for positive ratios, 'logit' for shares of a whole, 'plain' for others
    The value is the ratio of the means over runs.
    """
    totals, weights, labels = _known(total, weight, unit)
    if not len(labels):
        return Interval(math.nan, math.nan, math.nan)
    f = _scale(totals, weights, labels, scale)
    value = _ratio(totals.mean(0).sum(), weights.mean(0).sum())
    parts = [ground_variance(totals, weights, labels, f)]
    if len(totals) > 1:
        parts.append(run_variance([float(f(_ratio(a.sum(), b.sum()))) for a, b in zip(totals, weights, strict=True)]))
    noise = join(parts)
    reach = student_quantile(noise.freedom) * math.sqrt(noise.value) if noise.freedom > 0 else math.nan
    back: Callable[[float], float] = {np.log: np.exp, special.logit: special.expit}.get(f, float)
    if not (math.isfinite(reach) and math.isfinite(value)):
        return Interval(float(value), math.nan, math.nan)
    middle = float(f(value))
    return Interval(float(value), _bound(back, middle - reach), _bound(back, middle + reach))


def gain_interval(ours: NDArray, other: NDArray, unit: NDArray) -> Interval:
    """By how many percent ``ours`` lowers the summed squared error of ``other``, paired unit by unit.

    ours, other : (N,) or (runs, N) sums of squared errors; unit : (N,) labels of pieces of ground
    """
    ratio = ratio_interval(ours, other, unit)
    return Interval(100 * (1 - ratio.value), 100 * (1 - ratio.high), 100 * (1 - ratio.low))


def ground_variance(
    total: NDArray, weight: NDArray, unit: NDArray, f: Callable[[NDArray], NDArray] = np.asarray
) -> Variance:
    """Jackknife variance of f(sum(total) / sum(weight)), means over runs; freedom 0 for less than two units.

    total, weight : (runs, N); unit : (N,)
    """
    totals, weights, count = _per_unit(total, weight, unit)
    if count < 2:
        return Variance(math.nan, 0.0)
    without = f(_ratio(totals.sum() - totals, weights.sum() - weights))
    spread = np.square(without - f(_ratio(totals.sum(), weights.sum()))).sum() * (count - 1) / count
    return Variance(float(spread), max(1.0, effective_units(weights) - 1))


def run_variance(values: Sequence[float]) -> Variance:
    """Variance of the mean of independent training runs; freedom 0 for one run."""
    if len(values) < 2:
        return Variance(math.nan, 0.0)
    return Variance(float(np.var(values, ddof=1)) / len(values), len(values) - 1.0)


def effective_units(weights: NDArray) -> float:
    """How many units of equal weight tell as much: (sum w)^2 / sum w^2."""
    return float(np.square(weights.sum()) / np.square(weights).sum())


def join(parts: Sequence[Variance]) -> Variance:
    """The variance of a sum of independent parts; freedom 0 where a part is not known."""
    if any(part.freedom <= 0 for part in parts):
        return Variance(math.nan, 0.0)
    value = sum(part.value for part in parts)
    below = sum(part.value**2 / part.freedom for part in parts)
    # Without any spread all freedoms are equally true.
    return Variance(value, value**2 / below if below > 0 else max(part.freedom for part in parts))


def student_quantile(freedom: float, level: float = LEVEL) -> float:
    """Half width of the central interval of Student's t that holds ``level``."""
    return float(stats.t.ppf(0.5 + level / 2, freedom))


def two_sided_p(t: float, freedom: float) -> float:
    """Probability that |Student's t| exceeds |t|."""
    return float(2 * stats.t.sf(abs(t), freedom))


def _known(total: NDArray, weight: NDArray, unit: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    totals, weights = np.broadcast_arrays(
        np.atleast_2d(np.asarray(total, float)), np.atleast_2d(np.asarray(weight, float))
    )
    known = (np.isfinite(totals) & np.isfinite(weights)).all(axis=0)
    return totals[:, known], weights[:, known], np.asarray(unit)[known]


def _per_unit(total: NDArray, weight: NDArray, unit: NDArray) -> tuple[NDArray, NDArray, int]:
    """Sums over each unit of the means over runs, (units,) each; units without weight do not count."""
    _, index = np.unique(unit, return_inverse=True)
    totals, weights = (np.bincount(index, np.atleast_2d(v).mean(0)) for v in (total, weight))
    counts = weights > 0
    return totals[counts], weights[counts], int(counts.sum())


def _scale(total: NDArray, weight: NDArray, unit: NDArray, scale: str) -> Callable[[NDArray], NDArray]:
    """The logarithm (logit) where it exists for every ratio that is asked for."""
    if scale == "plain":
        return np.asarray
    totals, weights, _ = _per_unit(total, weight, unit)
    without = _ratio(totals.sum() - totals, weights.sum() - weights)
    runs = _ratio(total.sum(axis=1), weight.sum(axis=1))
    asked = np.concatenate([without, runs])
    if scale == "logit":
        return special.logit if bool(((asked > 0) & (asked < 1)).all()) else np.asarray
    return np.log if bool((asked > 0).all()) else np.asarray


def _ratio(above: NDArray | float, below: NDArray | float) -> NDArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.asarray(above, float) / np.asarray(below, float))


def _bound(back: Callable[[float], float], value: float) -> float:
    with np.errstate(over="ignore"):  # few units of very unequal weight: nothing bounds the ratio
        return float(back(value))
