"""Ground truth: a fractal surface with craters, or measured relief, several times finer than the DEM that the simulation gets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter


def red_noise(rng: np.random.Generator, size: int, power: float, shortest: float = 2.0) -> np.ndarray:
    """Gaussian field of unit rms whose power falls as k^-power, with nothing shorter than ``shortest`` px."""
    ky, kx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)
    k = np.hypot(ky, kx)
    amplitude = np.where(k > 0, np.maximum(k, 1 / size) ** (-power / 2), 0) * np.exp(-((k * shortest / 2) ** 4))
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * amplitude
    field = np.fft.irfft2(spectrum, s=(size, size))
    return (field - field.mean()) / field.std()


def make_terrain(rng: np.random.Generator, size: int, cell: float, slope_deg: float) -> np.ndarray:
    """Heights (size, size), m, with an rms slope of ``slope_deg`` at the scale of six cells."""
    height = red_noise(rng, size, 3.6, 3.0) * 1.0
    y, x = np.mgrid[0:size, 0:size].astype(float)
    craters = np.zeros_like(height)
    radii = np.exp(rng.uniform(np.log(5), np.log(size / 6), size=max(12, size // 8)))
    for radius in np.sort(radii)[::-1]:
        cy, cx = rng.uniform(0, size, 2)
        t = np.hypot(y - cy, x - cx) / radius
        depth = radius * cell * 0.28 * rng.uniform(0.4, 1)
        bowl = np.where(t < 1, (t**2 - 1) * depth + 0.2 * depth, 0.2 * depth * np.exp(-3 * np.maximum(t - 1, 0)))
        craters += bowl * (t < 3)
    height *= 0.5 * craters.std() + 0.01 * size * cell
    return _steep(height + craters, cell, slope_deg)


def measured_relief(rng: np.random.Generator, path: Path, size: int, cell: float, slope_deg: float) -> np.ndarray:
    """A piece of a real DEM, turned and mirrored at random, its pixels taken for cells and its heights for such slopes."""
    import rasterio

    with rasterio.open(path) as file:
        height = file.read(1).astype(float)
    if min(height.shape) < size:
        raise ValueError(f"{path}: {height.shape} pixels, where {size} x {size} are needed")
    y, x = (int(rng.integers(0, n - size + 1)) for n in height.shape)
    piece = np.rot90(height[y : y + size, x : x + size], int(rng.integers(4)))
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    return _steep(piece - piece.mean(), cell, slope_deg)


def _steep(height: np.ndarray, cell: float, slope_deg: float) -> np.ndarray:
    """Scaled to an rms slope at the scale of six cells."""
    size = len(height) // 6 * 6
    coarse = height[:size, :size].reshape(size // 6, 6, size // 6, 6).mean((1, 3))
    gy, gx = np.gradient(coarse, 6 * cell)
    return height * np.tan(np.radians(slope_deg)) / np.sqrt((gx**2 + gy**2).mean())


def patches(rng: np.random.Generator, size: int, width: float) -> np.ndarray:
    """Gaussian field of unit rms without a tail of large structure: blankets of ejecta of ``width`` cells."""
    field = gaussian_filter(rng.normal(size=(size, size)), width / 2.355, mode="wrap")
    return (field - field.mean()) / field.std()


def units(rng: np.random.Generator, size: int) -> np.ndarray:
    """Four kinds of ground with sharp borders, of unit rms."""
    field = np.digitize(red_noise(rng, size, 3.2, 6.0), [-0.8, 0.3, 1.1]).astype(float)
    return (field - field.mean()) / field.std()
