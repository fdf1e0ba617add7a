"""The DEM that the file gives: the true ground smoothed, with noise of its own and, in some scenes, a seam."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from .fields import Array, block_mean, rms_slope
from .ground import Ground


@dataclass
class DemErrors:
    smoothing: float  # px, Gaussian
    noise_deg: float  # rms slope of the noise
    noise_length: float  # px
    seam: float  # height of the step, px
    noise: Array  # (grid, grid), m: noise and seam


def draw_dem_errors(rng: np.random.Generator, grid: int, gsd: float) -> DemErrors:
    smoothing = rng.uniform(0.3, 0.8)
    noise_deg = rng.uniform(0.5, 1.0)
    length = rng.uniform(0.8, 2.5)
    noise = ndimage.gaussian_filter(rng.standard_normal((grid, grid)), length)
    noise *= math.tan(math.radians(noise_deg)) * gsd / rms_slope(noise, 1.0)
    seam = 0.0
    if rng.random() < 0.3:
        azimuth = rng.random() * 2 * np.pi
        y, x = np.mgrid[:grid, :grid] - grid / 2
        seam = rng.uniform(0.04, 0.15) * rng.choice([-1, 1])
        away = x * np.cos(azimuth) + y * np.sin(azimuth) + rng.uniform(-grid / 4, grid / 4)
        noise = noise + seam * gsd * 0.5 * np.tanh(away / 1.2)
    return DemErrors(smoothing, noise_deg, length, seam, noise)


def given_dem(ground: Ground, errors: DemErrors, more_smoothing: float = 0.0) -> Array:
    """(grid, grid), m; `more_smoothing`: variance of a planted further Gaussian (px2)."""
    sigma = math.sqrt(errors.smoothing**2 + more_smoothing)
    smooth = ndimage.gaussian_filter(ground.height.astype(float), sigma * ground.fine, mode="nearest")
    return block_mean(smooth, ground.fine) + errors.noise
