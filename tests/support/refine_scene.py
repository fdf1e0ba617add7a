"""Relief that a DEM lacks, in closed form, and its photographs: the means over pixels of a four times finer ground, blurred by optics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from albedo_scene import NOISE, SIZE, SUNS
from scipy.ndimage import gaussian_filter
from small_scene import GSD, A, B, C, slopes, sun_enu

FINER = 4
BLUR_PX = 0.4  # of the optics


@dataclass(frozen=True)
class Waves:
    """A sum of plane waves. k : (K, 2) rad/m, east and north; amplitude : (K,) m; phase : (K,) rad"""

    k: np.ndarray
    amplitude: np.ndarray
    phase: np.ndarray

    def heights(self, x, y):
        """Mean height over pixels of GSD about (x, y), m."""
        share = np.sinc(self.k * GSD / 2 / np.pi).prod(axis=1)
        return sum(
            s * a * np.sin(k[0] * x + k[1] * y + p)
            for k, a, p, s in zip(self.k, self.amplitude, self.phase, share, strict=True)
        )

    def slopes(self, x, y):
        """(dz/dx, dz/dy) at points."""
        found = np.zeros((2, *np.broadcast_shapes(x.shape, y.shape)))
        for k, a, p in zip(self.k, self.amplitude, self.phase, strict=True):
            found += a * k[:, None, None] * np.cos(k[0] * x + k[1] * y + p)
        return found


def missing_waves(rng, slope: float = 0.05, shortest: float = 4.0, longest: float = 10.0, count: int = 24) -> Waves:
    """Waves of all directions between two wavelengths, px, that make slopes of this rms together."""
    length, direction = rng.uniform(shortest, longest, count) * GSD, rng.uniform(0, 2 * np.pi, count)
    size = 2 * np.pi / length
    k = size[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    return Waves(k, slope * np.sqrt(2 / count) / size, rng.uniform(0, 2 * np.pi, count))


def axes(finer: int = 1):
    half, step = SIZE * GSD / 2, GSD / finer
    axis = (np.arange(SIZE * finer) + 0.5) * step - half
    return axis[None, :], -axis[:, None]


def photographs(rng, albedo: np.ndarray, waves: Waves, suns=SUNS) -> list[np.ndarray]:
    """I/F of M2 times the albedo under a vertical camera far away, with noise."""
    x, y = axes(FINER)
    east, north = np.asarray(slopes(x, y)) + waves.slopes(x, y)
    found = []
    for sun in suns:
        s = sun_enu(subsolar=sun)
        mu0 = (s[2] - east * s[0] - north * s[1]) / np.sqrt(1 + east**2 + north**2)
        light = np.where(mu0 > 0, A * mu0 + B * s[2] + C, 0)
        light = gaussian_filter(light, BLUR_PX * FINER)
        mean = light.reshape(SIZE, FINER, SIZE, FINER).mean(axis=(1, 3))
        found.append(albedo * mean + NOISE * rng.normal(size=albedo.shape))
    return found
