"""Random relief on a metric grid: the ground that rays are cast at and maps are rendered of."""

from __future__ import annotations

import numpy as np
from rasterio.transform import Affine

from stages.physics.maps.grid import Grid, local_metric_crs, unit_vectors

RADIUS = 1737400.0


def metric_grid(height: int, width: int, gsd: float, lon: float, lat: float) -> Grid:
    """A grid of ``height`` x ``width`` pixels whose middle is the centre of its own projection."""
    crs = local_metric_crs(lon, lat, RADIUS)
    return Grid(crs.to_wkt(), Affine(gsd, 0, -width * gsd / 2, 0, -gsd, height * gsd / 2), height, width, RADIUS)


def hills(rng: np.random.Generator, size: int, gsd: float, steepness: float = 0.35) -> np.ndarray:
    """Smooth random relief with slopes of about ``steepness``."""
    spectrum = np.fft.rfft2(rng.normal(size=(size, size)))
    fy, fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]
    wave = np.hypot(fx, fy)
    wave[0, 0] = 1.0
    z = np.fft.irfft2(spectrum * wave**-2.2 * np.exp(-((wave * 8) ** 2)), s=(size, size))
    slope = np.hypot(*np.gradient(z, gsd))
    return (z * steepness / np.sqrt((slope**2).mean())).astype(np.float32)


def body_point(grid: Grid, row: float, col: float, height: float) -> np.ndarray:
    """Where ``height`` metres above a pixel's centre is, in the body's axes, m."""
    return unit_vectors(*(float(v) for v in grid.lonlat(row, col))) * (grid.radius + height)
