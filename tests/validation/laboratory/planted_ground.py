"""Effects of the ground: an albedo that follows the relief, and one that follows nothing of it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from scipy import ndimage

from .fields import Array, fractal, log_uniform, refine, standardised
from .layout import Needs
from .plant import Plant


class AlbedoOf(Plant, ABC):
    """Albedo times 1 + x z, where z is a standardised map of pixels."""

    def draw(self, rng: np.random.Generator) -> None:
        self.start = self.low = self.high = log_uniform(rng, 0.012, 0.08)  # a strength as the ground may have it
        pattern = self.pattern(rng)
        ground = self.scene.ground
        self.fine = refine(pattern, ground.fine, ground.height.shape[0]).astype(np.float32)

    @abstractmethod
    def pattern(self, rng: np.random.Generator) -> Array:
        """(grid, grid): mean 0 and deviation 1 over the crops."""

    def standardised(self, values: Array) -> Array:
        crops = self.scene.sites.crops(values)
        return (values - crops.mean()) / crops.std()

    def iof(self, pair: int, x: float) -> Array:
        pattern = self.scene.cut(self.fine, self.scene.pairs[pair][0])
        return self.scene.plain(pair) * np.maximum(1 + self.sign * x * pattern, 0.1)

    def parameters(self, x: float) -> dict:
        return {"per_std": self.sign * x}


class SlopeAlbedo(AlbedoOf):
    name = "slope_albedo"

    def pattern(self, rng: np.random.Generator) -> Array:
        gy, gx = np.gradient(self.scene.ground.pixels, self.scene.ground.gsd)
        self.sign = float(rng.choice([1, 1, -1]))  # fresh slopes are brighter, mostly
        return self.standardised(np.degrees(np.arctan(np.hypot(gx, gy))))


class ElevationAlbedo(AlbedoOf):
    name = "elevation_albedo"

    def pattern(self, rng: np.random.Generator) -> Array:
        return self.standardised(ndimage.gaussian_filter(self.scene.ground.pixels, 1.6))


class CurvatureAlbedo(AlbedoOf):
    name = "curvature_albedo"

    def pattern(self, rng: np.random.Generator) -> Array:
        return self.standardised(ndimage.gaussian_laplace(self.scene.ground.pixels, 2.0))


class AlbedoMap(AlbedoOf):
    """Rays and the border of a mare; deviation 1 within a crop, on average."""

    name = "albedo_map"
    needs = Needs(no_albedo_border=True)

    def pattern(self, rng: np.random.Generator) -> Array:
        sites = self.scene.sites
        n = sites.grid
        self.sign = 1.0
        y, x = np.mgrid[:n, :n].astype(float)
        found = np.zeros((n, n))
        for _ in range(6):
            azimuth = rng.random() * np.pi
            across = x * np.cos(azimuth) + y * np.sin(azimuth)
            centre = rng.choice(across.ravel())
            width = rng.uniform(12, 35)
            ray = rng.uniform(0.5, 1) * np.exp(-0.5 * ((across - centre) / width) ** 2)
            along = x * np.sin(azimuth) - y * np.cos(azimuth)
            found += ray * (1 + 0.3 * np.sin(along / rng.uniform(15, 40)))
        azimuth = rng.random() * 2 * np.pi
        away = (x - n / 2) * np.cos(azimuth) + (y - n / 2) * np.sin(azimuth)
        found += np.tanh((away + 12 * standardised(fractal(n, 0.9, 80, rng))) / 12)
        found = found / math.sqrt(np.mean([crop.var() for crop in sites.crops(found)]))
        return found - sites.crops(found).mean()


EFFECTS = (SlopeAlbedo, ElevationAlbedo, CurvatureAlbedo, AlbedoMap)
