"""95 % intervals over ground: delete-one-unit jackknife of ratios with Student's t, and the spread over training runs.

Pairs on one ground tile share terrain and images, so tiles and not pairs are independent. Everything compared is a
ratio of sums over tiles: a mean squared error (squared errors over pixels), a gain (errors of one model over those of
another, paired tile by tile), a share of matches (hits over matches). With the ratio R of all units and R_k of all but
unit k, on a scale f that takes out skewness (errors: -R^(-1/2); gains: logarithm; shares: logit):

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
from scipy import special

LEVEL = 0.95
FEWEST_UNITS = 4  # coverage is tested from here on
TINY = 1e-300


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


@dataclass(frozen=True)
class Scale:
    """A transformation that makes a ratio nearly normal, its inverse, and the bounds between which it exists."""

    to: Callable[[NDArray], NDArray]
    back: Callable[[float], float]
    low: float = -math.inf
    high: float = math.inf


PLAIN = Scale(np.asarray, float)
LOG = Scale(np.log, np.exp, 0.0)
LOGIT = Scale(special.logit, special.expit, 0.0, 1.0)
# Squared errors per tile scatter like a lognormal law with a deviation of 60 to 70 %: the mean of few is skewed even
# on a logarithm. Where -R^(-1/2) reaches 0, nothing bounds the error from above.
ERROR = Scale(lambda ratio: -(ratio**-0.5), lambda value: value**-2 if value < 0 else math.inf, 0.0)


def choose_units(tile: NDArray, site: NDArray) -> tuple[NDArray, str]:
    """Labels of the independent pieces of ground, (N,), and their name: tiles, or the sites of a single tile."""
    return (tile, "tile") if len(np.unique(tile)) > 1 else (site, "site")


def ratio_interval(total: NDArray, weight: NDArray, unit: NDArray, scale: Scale = PLAIN) -> Interval:
    """sum(total) / sum(weight) with its 95 % interval over ground and training runs.

    total : (N,) or (runs, N); weight : likewise, or (N,) for all runs; unit : (N,) labels of pieces of ground. Entries
    that are not finite do not count.
    The value is the ratio of the means over runs. Where a ratio lies outside the bounds of ``scale``, none is used.
    """
    totals, weights = _per_unit(total, weight, unit)
    if not totals.size:
        return Interval(math.nan, math.nan, math.nan)
    value = float(_ratio(totals.mean(0).sum(), weights.mean(0).sum()))
    runs = _ratio(totals.sum(axis=1), weights.sum(axis=1))
    ratios = np.concatenate([_without_one(totals.mean(0), weights.mean(0)), runs])
    if not bool(((ratios > scale.low) & (ratios < scale.high)).all()):
        scale = PLAIN
    parts = [_ground_variance(totals.mean(0), weights.mean(0), scale)]
    if len(totals) > 1:
        parts.append(run_variance(scale.to(runs)))
    noise = join(parts)
    reach = student_quantile(noise.freedom) * math.sqrt(noise.value) if noise.freedom > 0 else math.nan
    if not (math.isfinite(reach) and math.isfinite(value)):
        return Interval(value, math.nan, math.nan)
    middle = float(scale.to(np.asarray(value)))
    with np.errstate(over="ignore"):  # few units of very unequal weight: nothing bounds the ratio
        return Interval(value, float(scale.back(middle - reach)), float(scale.back(middle + reach)))


def gain_interval(ours: NDArray, other: NDArray, unit: NDArray) -> Interval:
    """By how many percent ``ours`` lowers the summed squared error of ``other``, paired unit by unit.

    ours, other : (N,) or (runs, N) sums of squared errors; unit : (N,) labels of pieces of ground
    """
    ratio = ratio_interval(ours, other, unit, LOG)
    return Interval(100 * (1 - ratio.value), 100 * (1 - ratio.high), 100 * (1 - ratio.low))


def ground_variance(total: NDArray, weight: NDArray, unit: NDArray, scale: Scale = PLAIN) -> Variance:
    """Jackknife variance of sum(total) / sum(weight) on ``scale``, means over runs; freedom 0 for less than two units.

    total, weight : (runs, N); unit : (N,)
    """
    totals, weights = _per_unit(total, weight, unit)
    return _ground_variance(totals.mean(0), weights.mean(0), scale)


def run_variance(values: Sequence[float] | NDArray) -> Variance:
    """Variance of the mean of independent training runs, from (runs,) values; freedom 0 for one run."""
    if len(values) < 2:
        return Variance(math.nan, 0.0)
    return Variance(float(np.var(values, ddof=1)) / len(values), len(values) - 1.0)


def effective_units(weights: NDArray) -> float:
    """The number of units of equal weight with the same information: (sum w)^2 / sum w^2. weights : (units,)"""
    return float(np.square(weights.sum()) / np.square(weights).sum())


def join(parts: Sequence[Variance]) -> Variance:
    """The variance of a sum of independent parts; freedom 0 where a part is not known."""
    if any(part.freedom <= 0 for part in parts):
        return Variance(math.nan, 0.0)
    value = sum(part.value for part in parts)
    below = sum(part.value**2 / part.freedom for part in parts)
    # Without any spread all freedoms are equally true.
    return Variance(value, value**2 / below if below > 0 else max(part.freedom for part in parts))


def student_quantile(freedom: float) -> float:
    """Half width of the central 95 % interval of Student's t."""
    return float(special.stdtrit(freedom, 0.5 + LEVEL / 2))


def two_sided_p(t: float, freedom: float) -> float:
    """Probability that |Student's t| exceeds |t|."""
    return float(2 * special.stdtr(freedom, -abs(t)))


def unseen_quantile(values: NDArray, unit: NDArray, share: float) -> float:
    """What a share of the values of a unit stay below that is not among these units, on the average over such units.

    The quantile of all values, times the same quantile of each unit's values over that of all other units: a quantile of
    few units is too low for the next one. values, unit : (N,); cross-conformal prediction by units (Vovk 2015, Ann. Math.
    Artif. Intell. 74:9).
    """
    found = float(np.quantile(values, share))
    return found * float(unseen_factors(values, unit, lambda own: np.quantile(values[~own], [[share]]), [share])[0])


def unseen_factors(
    values: NDArray, unit: NDArray, widths: Callable[[NDArray], NDArray], shares: Sequence[float]
) -> NDArray:
    """Factors on widths, (S,), by which a share of the values of a unit stay below that is not among these units.

    values, unit : (N,); widths : of a mask (N,) of one unit -> (S, n) for its values, or alike, from all other units
    """
    names, index = np.unique(unit, return_inverse=True)
    if len(names) < 2:
        return np.ones(len(shares))
    over = np.empty((len(shares), len(values)))
    for k in range(len(names)):
        own = index == k
        over[:, own] = values[own] / np.maximum(widths(own), TINY)
    return np.array([np.quantile(ratio, share) for ratio, share in zip(over, shares, strict=True)])


def _per_unit(total: NDArray, weight: NDArray, unit: NDArray) -> tuple[NDArray, NDArray]:
    """Sums over each unit of what is finite in all runs, (runs, units) each; units without weight do not count."""
    pairs = np.broadcast_arrays(*(np.atleast_2d(np.asarray(v, float)) for v in (total, weight)))
    known = (np.isfinite(pairs[0]) & np.isfinite(pairs[1])).all(axis=0)
    _, index = np.unique(np.asarray(unit)[known], return_inverse=True)
    totals, weights = (np.stack([np.bincount(index, run[known]) for run in values]) for values in pairs)
    weighty = weights.sum(0) > 0
    return totals[:, weighty], weights[:, weighty]


def _ground_variance(totals: NDArray, weights: NDArray, scale: Scale) -> Variance:
    """ground_variance of sums over units, (units,) each."""
    count = len(weights)
    if count < 2:
        return Variance(math.nan, 0.0)
    without_one, whole = scale.to(_without_one(totals, weights)), scale.to(_ratio(totals.sum(), weights.sum()))
    spread = np.square(without_one - whole).sum() * (count - 1) / count
    return Variance(float(spread), max(1.0, effective_units(weights) - 1))


def _without_one(totals: NDArray, weights: NDArray) -> NDArray:
    """The ratio of all units but one, (units,); empty for a single unit."""
    return _ratio(totals.sum() - totals, weights.sum() - weights)[: len(weights) * (len(weights) > 1)]


def _ratio(above: NDArray | float, below: NDArray | float) -> NDArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.asarray(above, float) / np.asarray(below, float))
