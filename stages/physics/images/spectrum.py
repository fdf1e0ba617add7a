"""Fields by spatial frequency: the variance that a prior gives to each wave, and what is found of it.

Waves are those of the orthonormal cosine transform, which does not wrap around (Strang 1999, SIAM Rev. 41:135): white
noise of variance v per pixel has the variance v in each of them, whatever the size of a window.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy import fft

from stages.common.arrays import Floats, Floats32

WAVELENGTHS = 2.0 ** np.arange(
    6.0, 0.4, -0.5
)  # px: between these the logarithm of a variance is linear in that of the frequency
_LOG_FREQUENCY = -np.log(WAVELENGTHS)
LEAST = 1e-30
SMOOTHED_PX = 4.0  # over which the squares of draws are averaged


@dataclass(frozen=True)
class Spectrum:
    """Variance of a field's waves at WAVELENGTHS, (K,) or of several fields (n, K); beyond the ends it is that of the ends.

    0 everywhere for a known field.
    """

    variance: Floats

    def of(self, shape: tuple[int, int]) -> Floats32:
        """(H, W) variance of every wave of a window, (n, H, W) of several fields."""
        if self.variance.ndim > 1:
            return np.stack([Spectrum(v).of(shape) for v in self.variance])
        if not self.variance.any():
            return np.zeros(shape, np.float32)
        logs = np.log(np.maximum(self.variance, LEAST))
        return np.exp(np.interp(_log_frequency(shape), _LOG_FREQUENCY, logs)).astype(np.float32)

    def scatter(self, size: int = 256) -> float:
        """Standard deviation of the field itself."""
        return float(np.sqrt(self.of((size, size)).mean(dtype=float)))


@lru_cache(8)
def frequencies(shape: tuple[int, int]) -> tuple[Floats32, Floats32]:
    """(H, 1) and (1, W) rad/px of a window's waves."""
    rows, cols = (np.pi * np.arange(n) / n for n in shape)
    return rows[:, None].astype(np.float32), cols[None].astype(np.float32)


@lru_cache(8)
def _log_frequency(shape: tuple[int, int]) -> Floats:
    """(H, W) of every wave, cycles/px."""
    rows, cols = frequencies(shape)
    return np.log(np.maximum(np.hypot(rows, cols), 1e-6) / (2 * np.pi))


@lru_cache(4)
def _shares(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """(H W,) knots below each wave, and the share of the next one."""
    place = np.interp(_log_frequency(shape).ravel(), _LOG_FREQUENCY, np.arange(len(WAVELENGTHS)))
    below = np.minimum(place.astype(int), len(WAVELENGTHS) - 2)
    return below, place - below


def by_wavelength(power: Floats32) -> Floats:
    """(K,) sums of the waves' power (H, W), shared out to the nearest of WAVELENGTHS."""
    below, share = _shares(power.shape)
    values = power.ravel().astype(float)
    values[0] = 0.0  # the mean, of which a correction has none and an albedo may have any
    found = np.zeros(len(WAVELENGTHS))
    found += np.bincount(below, values * (1 - share), len(WAVELENGTHS))
    found += np.bincount(below + 1, values * share, len(WAVELENGTHS))
    return found


def waves(fields: Floats32) -> Floats32:
    """Fields (..., H, W) as the coefficients of their waves."""
    return np.asarray(fft.dctn(fields, axes=(-2, -1), norm="ortho"), np.float32)


def collect(coefficients: Floats32) -> Floats32:
    """The inverse of :func:`waves`: (..., H, W) coefficients -> fields."""
    return np.asarray(fft.idctn(coefficients, axes=(-2, -1), norm="ortho"), np.float32)


def smoothed(squares: Floats32) -> Floats32:
    """Local mean of squares of draws (H, W)."""
    return np.asarray(cv2.GaussianBlur(squares, (0, 0), SMOOTHED_PX), np.float32)
