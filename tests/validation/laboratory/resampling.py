"""Values between the samples of a grid (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

NEAREST, BILINEAR, CUBIC = 0, 1, 2


@njit(cache=True, fastmath=True)
def bilinear(grid: np.ndarray, r: float, c: float) -> float:
    """Value at row r, column c; beyond the border that of the border."""
    n, m = grid.shape
    if r < 0.0:
        r = 0.0
    if c < 0.0:
        c = 0.0
    if r > n - 1.001:
        r = n - 1.001
    if c > m - 1.001:
        c = m - 1.001
    i = int(r)
    j = int(c)
    a = r - i
    b = c - j
    return (1 - a) * ((1 - b) * grid[i, j] + b * grid[i, j + 1]) + a * (
        (1 - b) * grid[i + 1, j] + b * grid[i + 1, j + 1]
    )


@njit(cache=True)
def keys(x: float) -> float:
    """Weight at distance x < 2 of the cubic convolution with a = -0.5: Keys 1981, IEEE ASSP 29, 1153."""
    if x < 1:
        return (1.5 * x - 2.5) * x * x + 1
    return ((-0.5 * x + 2.5) * x - 4) * x + 2


@njit(cache=True)
def resample(image: np.ndarray, rows: np.ndarray, cols: np.ndarray, mode: int) -> np.ndarray:
    """Image at (rows, cols), which have the shape of the result; mode NEAREST, BILINEAR or CUBIC."""
    n, m = image.shape
    out = np.empty(rows.shape)
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            r = rows[i, j]
            c = cols[i, j]
            if mode == NEAREST:
                a = min(max(int(math.floor(r + 0.5)), 0), n - 1)
                b = min(max(int(math.floor(c + 0.5)), 0), m - 1)
                out[i, j] = image[a, b]
            elif mode == BILINEAR:
                out[i, j] = bilinear(image, r, c)
            else:
                a = int(math.floor(r))
                b = int(math.floor(c))
                s = 0.0
                for u in range(-1, 3):
                    wu = keys(abs(r - a - u))
                    for v in range(-1, 3):
                        wv = keys(abs(c - b - v))
                        s += wu * wv * image[min(max(a + u, 0), n - 1), min(max(b + v, 0), m - 1)]
                out[i, j] = s
    return out
