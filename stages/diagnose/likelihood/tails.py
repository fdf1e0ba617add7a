"""Tails of chi square and of Student's t, from scipy.special: scipy.stats takes more than a second to import."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc, gammaincc, gammainccinv, gammaln, stdtr


def surprise(ratio: NDArray[np.float64], freedom: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """-log10 of the upper tail of chi square, by its leading term where that underflows."""
    ratio = np.maximum(ratio, 1e-12)
    leading = ratio / 2 - (freedom / 2 - 1) * np.log(ratio / 2) + gammaln(freedom / 2)
    exact = -np.log(np.maximum(gammaincc(freedom / 2, ratio / 2), 1e-300))
    return np.maximum(np.where(exact < 600, exact, leading) / math.log(10), 0.0)


def together(errors: float, count: int) -> float:
    """How far from nothing, as the root of the sum of squares in standard errors, ``count`` values lie by chance as rarely as one by ``errors``."""
    return math.sqrt(2 * float(gammainccinv(count / 2, erfc(errors / math.sqrt(2)))))


def student_tail(t: float, freedom: float) -> float:
    """Chance that Student's t exceeds t."""
    return float(stdtr(freedom, -t))


__all__ = ["student_tail", "surprise", "together"]
