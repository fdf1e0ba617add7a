"""Normal equations of columns whose sizes differ by many orders of magnitude."""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from stages.diagnose.likelihood.products import Array


def scaled_to_one(a: Array) -> tuple[Array, Array]:
    """A matrix with a diagonal of ones, and by what its rows and columns were multiplied."""
    scale = 1 / np.sqrt(np.maximum(a.diagonal(), 1e-30))
    return a * np.outer(scale, scale) + 1e-10 * np.eye(len(a)), scale


def cholesky(scaled: Array) -> tuple[Array, bool]:
    """Cholesky factor; columns that are alike to single precision, in which products are summed, are kept apart by as much as that takes."""
    for more in (0.0, 1e-7, 1e-6, 1e-5, 1e-4):
        try:
            return cho_factor(scaled + more * np.eye(len(scaled)))
        except LinAlgError:
            continue
    return cho_factor(scaled + 1e-2 * np.eye(len(scaled)))


def solve(a: Array, b: Array) -> Array:
    """x of a x = b, for a symmetric positive definite a."""
    scaled, scale = scaled_to_one(a)
    return scale * cho_solve(cholesky(scaled), scale * b)


__all__ = ["cholesky", "scaled_to_one", "solve"]
