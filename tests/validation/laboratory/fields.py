"""Random fields and the few operations on grids that every part needs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Array = NDArray[np.floating]


def fractal(size: int, hurst: float, longest: float, rng: np.random.Generator, shortest: float = 0.0) -> Array:
    """(size, size), unit variance: Gaussian field whose amplitude falls as k^-(hurst + 1).

    It is rolled off above the wavelength `longest` (px), and has nothing well below k = 1 / `shortest` (px) where that is given.
    """
    ky = fft.fftfreq(size)[:, None]
    kx = fft.rfftfreq(size)[None]
    k = np.sqrt(ky * ky + kx * kx)
    amplitude = (k * k + longest**-2.0) ** (-(hurst + 1) / 2)
    amplitude[0, 0] = 0
    if shortest > 0:
        amplitude = amplitude * (1 - np.exp(-((k * shortest) ** 4)))
    white = rng.standard_normal((size, size)).astype(np.float32)
    field = fft.irfft2(fft.rfft2(white) * amplitude, s=(size, size))
    return field / field.std()


def fractal_crop(size: int, hurst: float, longest: float, rng: np.random.Generator, shortest: float = 0.0) -> Array:
    """(size, size): `fractal` made on the next larger grid that transforms fast."""
    return fractal(fft.next_fast_len(size), hurst, longest, rng, shortest)[:size, :size]


def rms_slope(height: Array, spacing: float) -> float:
    """Root mean square of the tangent of the slope."""
    gy, gx = np.gradient(height, spacing)
    return math.sqrt(np.mean(gx * gx + gy * gy))


def block_mean(fine: Array, factor: int) -> Array:
    """Mean over blocks of factor x factor: fine grid to pixels."""
    n = fine.shape[0] // factor
    return fine[: n * factor, : n * factor].reshape(n, factor, n, factor).mean((1, 3))


def refine(coarse: Array, factor: int, size: int) -> Array:
    """(size, size): pixels to the fine grid, linearly."""
    at = (np.arange(size) + 0.5) / factor - 0.5
    return ndimage.map_coordinates(coarse, np.meshgrid(at, at, indexing="ij"), order=1, mode="nearest")


def standardised(values: Array) -> Array:
    """Mean 0, standard deviation 1."""
    values = values - values.mean()
    return values / values.std()


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))
