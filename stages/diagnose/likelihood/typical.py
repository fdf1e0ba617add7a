"""95 % intervals of ratios of sums over pieces of ground whose values are skewed: gains are large on few pieces, small on most, and of one sign.

Where nothing but chance makes the values differ from a common ratio, either way alike, each sum over some of the pieces is too large as often as too
small. So the ratios of all subsets cut the line into parts that hold the truth equally often (Hartigan 1969, J. Am. Stat. Assoc. 64, 1303).
Student's t takes one large gain among many of the same sign for scatter.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stages.common.intervals import LEVEL, effective_units, student_quantile

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


__all__ = ["typical_bounds"]
