"""The ground: relief (fractal or of a real DEM), craters of every age, and the texture of the albedo."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from .fields import Array, block_mean, fractal_crop, rms_slope
from .layout import Needs

DATA = Path(os.environ.get("LUNARGR_SHARED", Path(__file__).parents[4] / "shared")) / "data"
REAL = {  # file below DATA, metres per pixel, largest grid that it is used for
    "kepler": ("dem/kepler_lola.tif", 47.68, 804),
    "gld": ("apollo15/gld100_64ppd.tif", 474.0, 1024),
}
STAMP = 257  # px of a crater stamp
REACH = 3.2  # radii from its centre to its border
AGES = (0.03, 0.12, 0.25, 0.4, 0.6)  # diffusion lengths, in radii: fresh to nearly gone


@dataclass
class Ground:
    """The true ground on the fine grid, `fine` samples to a pixel of `gsd` metres."""

    gsd: float
    fine: int
    height: Array  # (grid * fine, grid * fine), m, float32
    pixels: Array  # (grid, grid), m: its means
    texture: Array  # like height: relative albedo, float32
    datum: float  # m, mean height above the reference sphere
    story: str

    @property
    def spacing(self) -> float:
        """Metres between samples of the fine grid."""
        return self.gsd / self.fine


def draw_ground(rng: np.random.Generator, needs: Needs, gsd: float, grid: int, fine: int) -> Ground:
    """Relief of a drawn slope; everything up to `height` is in pixels."""
    slope = math.tan(math.radians(rng.uniform(9.5, 14) if needs.steep else rng.uniform(5, 13)))
    hurst = rng.uniform(0.78, 0.97)
    bright_ejecta = np.ones((grid * fine, grid * fine), np.float32)
    kind, relief = _draw_relief(rng, hurst, grid, fine)
    craters = np.zeros((grid * fine, grid * fine))
    coverage = rng.uniform(0.15, 0.8) * (0.5 if kind != "fractal" else 1)
    bright_share = float(rng.choice([0, 0, 0.3, 0.6]))
    largest = rng.uniform(40, 90)
    count, fresh = add_craters(craters, bright_ejecta, fine, rng, coverage, 3.5, largest, bright_share)
    of_craters = rms_slope(block_mean(craters, fine), 1.0)
    height = relief * math.sqrt(max(slope**2 - of_craters**2, (0.45 * slope) ** 2)) + craters
    height *= slope / rms_slope(block_mean(height, fine), 1.0)
    datum = rng.uniform(-2500, 2500)
    height = (height * gsd - (height * gsd).mean() + datum).astype(np.float32)
    texture, said = _draw_texture(rng, needs, grid, fine)
    texture = (bright_ejecta * texture).astype(np.float32)
    story = (
        f"{kind} relief H={hurst:.2f}, craters {count} (cov {coverage:.2f}, {fresh} bright), "
        f"slope {math.degrees(math.atan(slope)):.1f} deg, {said}, gsd {gsd} m, fine x{fine}"
    )
    return Ground(gsd, fine, height, block_mean(height.astype(float), fine), texture, datum, story)


def read_dem(kind: str) -> Array:
    """(rows, cols), px: heights of a real DEM over its pixel size."""
    import rasterio

    name, metres, _ = REAL[kind]
    path = DATA / name
    if not path.exists():
        raise FileNotFoundError(
            f"{path} is missing: the laboratory's relief needs it (LUNARGR_SHARED names the folder)"
        )
    with rasterio.open(path) as source:
        return source.read(1).astype(float) / metres


def _draw_relief(rng: np.random.Generator, hurst: float, grid: int, fine: int) -> tuple[str, Array]:
    """A rms slope of 1, before craters."""
    kind = str(rng.choice(["fractal", "kepler", "gld"], p=[0.68, 0.16, 0.16]))
    if kind == "fractal" or grid > REAL[kind][2]:
        kind = "fractal"
        relief = fractal_crop(grid * fine, hurst, rng.uniform(60, 250) * fine, rng)
    else:
        dem = read_dem(kind)
        a = int(rng.integers(0, dem.shape[0] - grid + 1))
        b = int(rng.integers(0, dem.shape[1] - grid + 1))
        part = ndimage.gaussian_filter(dem[a : a + grid, b : b + grid], 0.8)
        part = np.rot90(part, int(rng.integers(4)))
        smooth = ndimage.zoom(part, fine, order=3, mode="nearest", grid_mode=True)
        of_dem = rms_slope(block_mean(smooth, fine), 1.0)
        # what the DEM does not resolve
        detail = fractal_crop(grid * fine, hurst, 40 * fine, rng, shortest=9.0 * fine)
        detail *= 0.55 * of_dem / rms_slope(block_mean(detail, fine), 1.0)
        relief = smooth + detail
    return kind, relief * (1.0 / rms_slope(block_mean(relief, fine), 1.0))


def _draw_texture(rng: np.random.Generator, needs: Needs, grid: int, fine: int) -> tuple[Array, str]:
    """Relative albedo on the fine grid: a log-normal fractal and, in some scenes, the border of a unit."""
    n = grid * fine
    power = rng.uniform(0.6, 1.6)
    rms = rng.uniform(0.015, 0.05)
    field = fractal_crop(n, power - 1, rng.uniform(20, 120) * fine, rng)
    border = 0.0
    if rng.random() < 0.25 and not needs.no_albedo_border:
        border = rng.uniform(0.02, 0.05) * rng.choice([-1, 1])
        azimuth = rng.random() * 2 * np.pi
        y, x = np.mgrid[:n, :n] / n - 0.5
        wobble = fractal_crop(n, 0.9, 100 * fine, rng)
        away = (x * np.cos(azimuth) + y * np.sin(azimuth)) * n / fine + 14 * wobble + rng.uniform(-60, 60)
        field = field + (border / rms) * np.tanh(away / rng.uniform(1.5, 5)) * 0.5
    said = f"texture {100 * rms:.1f}% beta {power:.1f}, border {100 * border:.1f}%"
    return np.exp(rms * field), said


def crater_stamps() -> list[Array]:
    """(STAMP, STAMP) each, in diameters: a fresh bowl with rim and ejecta after Pike 1977, and diffused ever further."""
    u = np.linspace(-REACH, REACH, STAMP)
    r = np.hypot(u[:, None], u[None])
    depth, rim = 0.155, 0.038
    bowl = np.maximum(-depth + (depth + rim) * r**2.4, -0.9 * depth)
    profile = np.where(r < 1, bowl, rim * np.maximum(r, 1e-3) ** -3.3)
    profile = profile * np.clip((REACH - r) / 0.8, 0, 1)
    px = (STAMP - 1) / (2 * REACH)
    return [ndimage.gaussian_filter(profile, age * px) for age in AGES]


def add_craters(
    height: Array,
    albedo: Array,
    fine: int,
    rng: np.random.Generator,
    coverage: float,
    smallest: float,
    largest: float,
    bright_share: float,
) -> tuple[int, int]:
    """Stamp craters into `height` (px) and bright ejecta into `albedo`; their numbers.

    The number above a diameter falls as its square, so that every octave covers the same area; `smallest` and `largest` in px.
    """
    stamps = crater_stamps()
    n = height.shape[0]
    mean_square = 2 * math.log(largest / smallest) * smallest**2
    count = int(coverage * n * n / (math.pi / 4 * mean_square * fine * fine))
    diameters = smallest * (1 - rng.random(count) * (1 - (smallest / largest) ** 2)) ** -0.5 * fine
    bright = 0
    for diameter in np.sort(diameters)[::-1]:
        radius = diameter / 2
        age = int(rng.choice(5, p=[0.12, 0.2, 0.26, 0.24, 0.18]))
        y, x = rng.random(2) * n
        half = REACH * radius
        rows = np.arange(max(int(y - half), 0), min(int(y + half) + 2, n))
        cols = np.arange(max(int(x - half), 0), min(int(x + half) + 2, n))
        if len(rows) < 2 or len(cols) < 2:
            continue
        here = np.ix_(rows, cols)
        height[here] += _stamped(stamps[age], rows, cols, y, x, radius) * (diameter * (1.0 / fine))
        if bright_share and age == 0 and diameter > 5 * fine and rng.random() < bright_share:
            away = np.hypot((rows[:, None] - y) / radius, (cols[None] - x) / radius)
            azimuth = np.arctan2(rows[:, None] - y, cols[None] - x)
            rays = 1 + 0.5 * np.cos(azimuth * rng.integers(4, 9) + rng.random() * 6)
            excess = rng.uniform(0.03, 0.12) * np.exp(-away / 1.1) * np.clip((REACH - away) / 0.8, 0, 1) * rays
            albedo[here] *= 1 + excess
            bright += 1
    return count, bright


def _stamped(stamp: Array, rows: np.ndarray, cols: np.ndarray, y: float, x: float, radius: float) -> Array:
    """(rows, cols): the stamp of a crater at (y, x), linearly between its samples."""
    at_y = np.clip(((rows - y) / radius + REACH) / (2 * REACH) * (STAMP - 1), 0, STAMP - 1)
    at_x = np.clip(((cols - x) / radius + REACH) / (2 * REACH) * (STAMP - 1), 0, STAMP - 1)
    i = np.minimum(at_y.astype(int), STAMP - 2)
    j = np.minimum(at_x.astype(int), STAMP - 2)
    b, a = (at_y - i)[:, None], (at_x - j)[None]
    upper = (1 - a) * stamp[np.ix_(i, j)] + a * stamp[np.ix_(i, j + 1)]
    lower = (1 - a) * stamp[np.ix_(i + 1, j)] + a * stamp[np.ix_(i + 1, j + 1)]
    return (1 - b) * upper + b * lower
