"""Effects of geometry: wrong Sun, wrong DEM, images that do not lie where they should."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from scipy import ndimage

from .dem import given_dem
from .exposure import Departure
from .fields import Array, log_uniform, standardised
from .geometry import direction
from .layout import Needs
from .plant import Plant


class SunError(Plant):
    """The file's Sun is the true one minus the error."""

    of_inputs = True
    turns_azimuth = False

    def sun(self, pair: int, x: float) -> Array:
        sun = self.scene.geometry.sun[pair]
        azimuth, elevation = math.atan2(sun[0], sun[1]), math.asin(sun[2])
        error = math.radians(self.sign * x)
        return direction(azimuth - error, elevation) if self.turns_azimuth else direction(azimuth, elevation - error)

    def iof(self, pair: int, x: float) -> Array:
        return self.scene.lit(pair, sun=self.sun(pair, x))

    def given_sun(self, x: float) -> Array:
        return np.array([self.sun(pair, x) for pair in range(len(self.scene.pairs))])

    def parameters(self, x: float) -> dict:
        return {"error_deg": self.sign * x}


class SunAzimuth(SunError):
    name = "sun_azimuth"
    turns_azimuth = True

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 4.0, log_uniform(rng, 0.5, 2.0), 40.0


class SunElevation(SunError):
    name = "sun_elevation"

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 1.5, log_uniform(rng, 0.2, 0.8), 7.0


class DemError(Plant, ABC):
    """The file's DEM is worse than the ground was; its images are orthorectified with it."""

    of_inputs = True
    needs = Needs(oblique=False)
    _worse: tuple[float, Array] | None = None  # the last strength and its ground

    @abstractmethod
    def worse(self, x: float) -> Array:
        """The ground on the fine grid, as this DEM would have it."""

    def iof(self, pair: int, x: float) -> Array:
        if self._worse is None or self._worse[0] != x:
            self._worse = (x, self.worse(x))
        return self.scene.lit(pair, height=self._worse[1])


class DemScale(DemError):
    name = "dem_scale"

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 0.12, log_uniform(rng, 0.02, 0.1), 0.45

    def worse(self, x: float) -> Array:
        datum = self.scene.datum
        return ((self.scene.ground.height - datum) / (1 + self.sign * x) + datum).astype(np.float32)

    def given_dem(self, x: float) -> Array:
        datum = self.scene.datum
        return datum + (self.scene.dem - datum) / (1 + self.sign * x)

    def parameters(self, x: float) -> dict:
        return {"relative": self.sign * x}


class DemSmoothing(DemError):
    name = "dem_smoothing"

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 1.0, rng.uniform(0.5, 1.2), 4.0

    def worse(self, x: float) -> Array:
        ground = self.scene.ground
        return ndimage.gaussian_filter(ground.height, math.sqrt(x) * ground.fine, mode="nearest", truncate=3.5)

    def given_dem(self, x: float) -> Array:
        return given_dem(self.scene.ground, self.scene.errors, more_smoothing=x)

    def parameters(self, x: float) -> dict:
        return {"sigma2_px2": x}


class Misregistration(Plant):
    name = "misregistration"
    needs = Needs(margin=20)

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 0.8, rng.uniform(0.5, 0.9), 6.0
        offsets = rng.standard_normal((self.scene.sites.images, 2))
        offsets -= offsets.mean(0)
        self.offsets = offsets / np.sqrt((offsets**2).sum(1).mean())

    def shift(self, x: float) -> Array:
        """(images, 2), px: added to what every camera has."""
        return self.scene.camera.shift + x * self.offsets

    def departure(self, x: float) -> Departure:
        return Departure(shift=self.shift(x))

    def parameters(self, x: float) -> dict:
        return {"rms_px": float(np.sqrt((self.shift(x) ** 2).sum(1).mean()))}


class LineJitter(Plant):
    """The pointing shakes from line to line, along and across the flight; rms beyond a constant over the lines in the data."""

    name = "line_jitter"
    needs = Needs(margin=20, line_scan=True)

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 0.7, rng.uniform(0.3, 0.7), 6.0
        scene, camera = self.scene, self.scene.camera
        lines = np.arange(int(camera.offset[:, 1].max() + camera.width) + 50)
        self.jitter = [np.array([_shaking(rng, lines) for _ in range(2)]) for _ in range(scene.sites.images)]
        shown: dict[int, list[Array]] = {}
        for pair, (_, image) in enumerate(scene.pairs):
            line = int((camera.affine[image] @ scene.geometry.centre[pair])[1] + camera.offset[image, 1])
            half = scene.size // 2
            shown.setdefault(image, []).append(self.jitter[image][:, max(line - half, 0) : line + half])
        for image, parts in shown.items():
            seen = np.concatenate(parts, 1)
            centred = self.jitter[image] - seen.mean(1, keepdims=True)
            self.jitter[image] = centred / math.sqrt(seen.var(1).sum())

    def departure(self, x: float) -> Departure:
        return Departure(jitter=[x * part for part in self.jitter])

    def parameters(self, x: float) -> dict:
        return {"rms_px": x}


def _shaking(rng: np.random.Generator, lines: Array) -> Array:
    """(lines,): a smooth random part and a vibration."""
    drift = standardised(ndimage.gaussian_filter1d(rng.standard_normal(len(lines)), rng.uniform(8, 30)))
    return drift + 0.6 * np.sin(2 * np.pi * lines / rng.uniform(15, 60) + rng.random() * 6)


class ReliefDisplacement(Plant):
    """The map projection left out a share of the relief."""

    name = "relief_displacement"
    needs = Needs(steep=True, oblique=True, margin=18)

    def draw(self, rng: np.random.Generator) -> None:
        at_one = self.rms(1.0)
        self.low = min(rng.uniform(0.25, 0.5) / at_one, 2.0)
        self.start, self.high = max(0.3, self.low), 2.5

    def rms(self, share: float) -> float:
        """px over all pixels."""
        scene = self.scene
        squares = []
        for pair, (site, _) in enumerate(scene.pairs):
            camera = scene.geometry.camera[pair]
            tangent = np.hypot(*camera[:2]) / camera[2]
            relief = scene.sites.crop(scene.ground.pixels, site) - scene.datum
            squares.append(((share * tangent / scene.ground.gsd * relief) ** 2).mean())
        return float(math.sqrt(np.mean(squares)))

    def departure(self, x: float) -> Departure:
        return Departure(relief_share=self.sign * x)

    def parameters(self, x: float) -> dict:
        return {"share": self.sign * x, "rms_px": self.rms(self.sign * x)}


EFFECTS = (SunAzimuth, SunElevation, DemScale, DemSmoothing, Misregistration, LineJitter, ReliefDisplacement)
