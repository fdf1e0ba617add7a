"""The ground: fractal relief, craters and boulders, made block by block, each block the same however the scene is cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from stages.common.arrays import Floats, Floats32
from stages.physics.relief.craters import Craters, populate, stamp
from stages.physics.relief.noise import fractal
from stages.simulate.recipe import Config


@dataclass(frozen=True)
class Ground:
    """A block of the ground: elevation (m above the sphere), freshness and rays, each (H, W) float32."""

    elevation: Floats32
    freshness: Floats32
    rays: Floats32


class Terrain:
    """The ground of a recipe as a function of place. Coordinates are map metres from the scene's centre."""

    def __init__(self, config: Config) -> None:
        self.config = config
        half = config.extent / 2
        self.bounds = (-half, -half, half, half)
        # the smallest craters that the grid can show at all
        smallest = 3.0 * config.dem_gsd
        largest = max(config.crater_largest, 1.5 * smallest)
        rng = np.random.default_rng([config.seed, 1])
        self.craters = populate(self.bounds, smallest, largest, config.crater_density, config.crater_transition, rng)
        self.boulders = scatter_boulders(config, self.craters, np.random.default_rng([config.seed, 2]))

    def block(self, row: int, col: int, height: int, width: int) -> Ground:
        """The block of DEM pixels whose first row and column are (row, col); may reach beyond the scene."""
        c = self.config
        step = c.dem_gsd
        x0 = self.bounds[0] + (col + 0.5) * step
        y0 = self.bounds[3] - (row + 0.5) * step
        shape = (height, width)
        elevation, freshness, rays = stamp(self.craters, x0, y0, step, shape)
        relief = fractal(
            shape, x0, y0, step, longest=c.relief_wavelength, shortest=3 * step, hurst=c.hurst, seed=c.seed * 7 + 1
        )
        elevation += np.float32(c.relief) * relief
        _add_boulders(elevation, x0, y0, step, *self.boulders)
        elevation += np.float32(c.base_elevation)
        return Ground(elevation, freshness, rays)


def scatter_boulders(config: Config, craters: Craters, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """x, y and diameter, (n,) m each, of boulders around young craters and a few anywhere.

    They are 1.2 to 5 DEM pixels across, with a cumulative slope of -3.5.
    """
    half = config.extent / 2
    area = (config.extent / 1000) ** 2
    total = rng.poisson(config.boulders_per_km2 * area)
    young = (craters.age < 0.08) & (craters.diameter > 40 * config.dem_gsd)
    near = int(0.8 * total) if young.any() else 0
    x, y = rng.uniform(-half, half, total), rng.uniform(-half, half, total)
    if near:
        pick = rng.choice(
            np.flatnonzero(young), near, p=craters.diameter[young] ** 2 / (craters.diameter[young] ** 2).sum()
        )
        azimuth = rng.uniform(0, 2 * np.pi, near)
        distance = 0.5 * craters.diameter[pick] * (0.5 + 1.2 * rng.random(near) ** 1.3)
        x[:near] = craters.x[pick] + distance * np.sin(azimuth)
        y[:near] = craters.y[pick] + distance * np.cos(azimuth)
    diameter = np.minimum(1.2 * config.dem_gsd * rng.random(total) ** (-1 / 3.5), 5 * config.dem_gsd)
    return x, y, diameter


@njit(cache=True)
def _add_boulders(elevation, x0, y0, step, x, y, diameter):
    height, width = elevation.shape
    for k in range(len(x)):
        radius = 0.5 * diameter[k]
        reach = 2.0 * radius
        r0, r1 = int((y0 - y[k] - reach) / step), int((y0 - y[k] + reach) / step) + 2
        c0, c1 = int((x[k] - reach - x0) / step), int((x[k] + reach - x0) / step) + 2
        for r in range(max(0, r0), min(height, r1)):
            for c in range(max(0, c0), min(width, c1)):
                dx, dy = x0 + c * step - x[k], y0 - r * step - y[k]
                t = (dx * dx + dy * dy) / (radius * radius)
                if t < 4.0:
                    elevation[r, c] += np.float32(0.8 * radius * np.exp(-1.2 * t))
