"""Errors by leaving out pieces of ground, 95 % intervals of gains, and tails of distributions.

Gains are large on few pieces of ground, small on most, and of one sign. Where chance alone moves them off a common ratio, either way alike, the
ratios of sums over all subsets of the pieces divide the line into parts that hold the truth equally often (Hartigan 1969, J. Am. Stat. Assoc. 64,
1303). Student's t takes one large gain among many of the same sign for scatter, and is used for few pieces only.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc, gammaincc, gammainccinv, gammaln, stdtr

from stages.common.arrays import Floats
from stages.common.intervals import LEVEL, effective_units, student_quantile
from stages.diagnose.settings import FOLDS

FEWEST = 6  # pieces, whose 63 subsets leave 3 % outside of them all; of fewer no interval holds 95 %
SEVERAL = 2.0  # pieces: one says nothing of its own scatter
EQUAL = 4.0  # of pieces that say as much as fewer equal ones (Kish) most subsets say nothing
ALL = 12  # pieces of which every subset is taken, and of more as many, drawn: the chance beyond a bound is known to a tenth


def typical_bounds(values: NDArray[np.float64], sizes: NDArray[np.float64]) -> tuple[float, float] | None:
    """Bounds of sum(values) / sum(sizes), of independent pieces (U,); None where these are too few. Pieces without size say nothing."""
    says = sizes > 0
    if says.sum() < FEWEST or (equal := effective_units(sizes[says])) < SEVERAL:
        return None
    if equal < EQUAL:
        return _alike(values[says], sizes[says])
    subsets = _subsets(int(says.sum()))
    ratios = np.sort((subsets @ values[says]) / (subsets @ sizes[says]))
    beyond = max(int((1 - LEVEL) / 2 * (len(ratios) + 1)), 1)
    return float(ratios[beyond - 1]), float(ratios[-beyond])


def _alike(values: NDArray[np.float64], sizes: NDArray[np.float64]) -> tuple[float, float]:
    """The same where a few pieces hold nearly all: the small ones tell by how much ratios scatter, if not how large the sum is.

    All ratios count alike. Those of small pieces scatter more, so the bounds are rather too wide.
    """
    ratio = float(values.sum() / sizes.sum())
    scatter = float(np.square(values / sizes - ratio).sum()) / (len(sizes) - 1)
    share = sizes / sizes.sum()
    half = student_quantile(len(sizes) - 1) * float(np.sqrt(scatter * (share @ share)))
    return ratio - half, ratio + half


@lru_cache(maxsize=64)
def _subsets(count: int) -> NDArray[np.float64]:
    """(subsets, count) of 0 and 1, none of them empty."""
    if count <= ALL:
        return ((np.arange(1, 2**count)[:, None] >> np.arange(count)) & 1).astype(np.float64)
    drawn = np.random.default_rng(count).random((2**ALL, count)) < 0.5
    return drawn[drawn.any(1)].astype(np.float64)


def interval(gains: Floats, sizes: Floats | None = None) -> tuple[float, float]:
    """95 % interval of a sum of gains over independent pieces of ground.

    sizes : of the pieces, to which gains are in proportion but for chance (a ratio estimate: Cochran 1977, ch. 6); alike where None
    """
    sizes = np.ones(len(gains)) if sizes is None or len(sizes) != len(gains) else sizes
    share = sizes / max(float(sizes.sum()), 1e-30)
    if bounds := typical_bounds(gains, share):
        return bounds
    error, freedom = _error(gains, share)
    if not freedom > 0:
        return -math.inf, math.inf
    half = student_quantile(freedom) * error
    return float(gains.sum()) - half, float(gains.sum()) + half


def gain_interval(before: Floats, after: Floats) -> tuple[float, float, float]:
    """Percent by which sums of squares per piece of ground (U,) get smaller in total, and the 95 % interval of that."""
    total = float(before.sum())
    if not total > 0:
        return math.nan, math.nan, math.nan
    low, high = interval(before - after, before)
    return 100 * (1 - float(after.sum()) / total), 100 * low / total, 100 * high / total


def chance(gains: Floats, sizes: Floats) -> float:
    """One-sided chance of such a sum of gains where there is none, by Student's t over the pieces; NaN for too few."""
    error, freedom = _error(gains, sizes / max(float(sizes.sum()), 1e-30))
    return float(stdtr(freedom, -float(gains.sum()) / max(error, 1e-30))) if freedom > 0 else math.nan


def _error(gains: Floats, share: Floats) -> tuple[float, float]:
    """Standard error of the sum about what goes with the pieces' shares, and its degrees of freedom."""
    units = effective_units(share) if share.any() else 0.0
    if units < 2 or len(gains) < 3:
        return math.inf, 0.0
    rest = gains - float(gains.sum()) * share
    return math.sqrt(units / (units - 1) * float(rest @ rest)), units - 1


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


def nats(before: float, after: float, pixels: float, per_sample: float) -> float:
    """Log likelihood that a smaller sum of squares gains, with one independent sample in so many pixels."""
    return 0.5 * pixels / per_sample * math.log(before / after) if before > 0 and after > 0 else math.nan


def surprise(ratio: NDArray[np.float64], freedom: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """-log10 of the upper tail of chi square, by its leading term where that underflows."""
    ratio = np.maximum(ratio, 1e-12)
    leading = ratio / 2 - (freedom / 2 - 1) * np.log(ratio / 2) + gammaln(freedom / 2)
    exact = -np.log(np.maximum(gammaincc(freedom / 2, ratio / 2), 1e-300))
    return np.maximum(np.where(exact < 600, exact, leading) / math.log(10), 0.0)


def together(errors: float, count: int) -> float:
    """How far from nothing, as the root of the sum of squares in standard errors, ``count`` values lie by chance as rarely as one by ``errors``."""
    return math.sqrt(2 * float(gammainccinv(count / 2, erfc(errors / math.sqrt(2)))))


__all__ = ["chance", "folds", "gain_interval", "interval", "jackknife_error", "nats", "surprise", "together"]
