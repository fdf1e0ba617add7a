"""The ground's relief and the DEM that somebody measured of it."""

import numpy as np
from scipy.ndimage import gaussian_filter

from .randomness import correlated_field, fractal_field, log_uniform, sign


def block_mean(field: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks of factor x factor cells."""
    rows, cols = field.shape[0] // factor, field.shape[1] // factor
    return field[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor).mean((1, 3))


def crater_profile(distance: np.ndarray, age: float) -> np.ndarray:
    """Height over diameter at a distance in radii: bowl, rim and ejecta; age 0 is fresh, 1 nearly erased."""
    depth, rim = 0.2 * (1 - age) ** 1.5 + 0.01, 0.04 * (1 - age) ** 2 + 0.002
    bowl = -depth + (depth + rim) * distance**2
    blanket = rim * np.maximum(distance, 0.5) ** -3.0 * np.clip((3 - distance) / 2, 0, 1)
    width = 0.06 + 0.35 * age  # diffusion rounds the rim
    outside = 1 / (1 + np.exp(-np.clip((distance - 1) / width * 2, -40, 40)))
    return np.minimum(bowl, 3 * rim + 0.02) * (1 - outside) + blanket * outside


def add_craters(rng: np.random.Generator, relief: np.ndarray, fine: int, density: float) -> None:
    """Stamp craters of a cumulative size law D^-2, diameters 3 to 70 map pixels, on relief in map pixels."""
    rows, cols = relief.shape
    count = rng.poisson(density * rows * cols / fine**2 / 100)
    diameters = np.minimum(3.0 * rng.uniform(size=count) ** -0.5, 70.0)
    for diameter in sorted(diameters, reverse=True):  # large ones first: the young are small
        age = float(rng.beta(2.0, 1.2))
        radius, reach = diameter * fine / 2, int(diameter * fine * 1.5) + 2
        row, col = rng.uniform(0, rows), rng.uniform(0, cols)
        top, left = max(0, int(row) - reach), max(0, int(col) - reach)
        part = relief[top : int(row) + reach, left : int(col) + reach]
        r = np.arange(top, top + part.shape[0])[:, None] - row
        c = np.arange(left, left + part.shape[1])[None, :] - col
        part += (diameter * crater_profile(np.hypot(r, c) / radius, age)).astype(np.float32)


def make_relief(rng: np.random.Generator, shape: tuple[int, int], fine: int) -> tuple[np.ndarray, str]:
    """Heights in map pixels on a grid `fine` times finer than the map's (shape in map pixels), and a description."""
    size = (shape[0] * fine, shape[1] * fine)
    hurst, longest = rng.uniform(0.8, 0.98), rng.uniform(40, 200)
    relief = fractal_field(rng, size, hurst, longest * fine)
    slope = np.hypot(*np.gradient(gaussian_filter(relief[:600, :600], fine * 0.7), 1 / fine)).std()
    wanted_deg = log_uniform(rng, 2.0, 7.0)
    relief *= np.float32(np.tan(np.radians(wanted_deg)) / slope)
    density = log_uniform(rng, 0.15, 1.2)
    add_craters(rng, relief, fine, density)
    text = f"fractal relief (H {hurst:.2f}, slopes about {wanted_deg:.0f} deg) with {density:.2f} craters per 100 px2"
    return relief, text


def smooth_relief(relief: np.ndarray, fine: int, variance_px2: float) -> np.ndarray:
    """Relief after a Gaussian of this variance, in map pixels squared."""
    return gaussian_filter(relief, fine * np.sqrt(max(variance_px2, 0.0)), truncate=4.0)


def height_errors(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Ordinary errors of a DEM's heights, map pixels: correlated noise and, in a third of scenes, seams."""
    length = rng.uniform(2.5, 10.0)
    slope_error = log_uniform(rng, 0.002, 0.008)
    errors = correlated_field(rng, shape, length) * np.float32(slope_error * length)
    if rng.uniform() < 0.33:
        for _ in range(rng.integers(1, 4)):
            step = sign(rng) * log_uniform(rng, 0.01, 0.05)
            axis = int(rng.integers(2))
            edge = int(rng.integers(shape[axis]))
            (errors[edge:] if axis == 0 else errors[:, edge:])[...] += np.float32(step)
    return errors


def measured_dem(relief: np.ndarray, fine: int, variance_px2: float, scale: float, errors: np.ndarray) -> np.ndarray:
    """The DEM: relief smoothed by a total variance (with the cell's own 1/12), divided by 1 + scale, with errors."""
    smooth = smooth_relief(relief, fine, variance_px2 - 1 / 12)
    return (block_mean(smooth, fine) / (1 + scale) + errors).astype(np.float32)
