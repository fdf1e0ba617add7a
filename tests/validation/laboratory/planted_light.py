"""Effects of light and of the law of reflectance."""

from __future__ import annotations

import math

import numpy as np

from .fields import Array, block_mean, log_uniform, refine
from .geometry import direction
from .layout import Needs
from .light import EAST, NORTH, SOUTH, WEST, bounce, horizon_elevation
from .plant import ABSOLUTE, GAINS, Plant

AROUND = 30  # px beyond the window that light may bounce from
AZIMUTHS, FARTHEST = 24, 60  # directions and px of its quadrature
SIDES = {EAST: "E", NORTH: "N", WEST: "W", SOUTH: "S"}


class Interreflection(Plant):
    """One bounce off diffuse facets of the law's albedo at (30, 0, 30); 1 is what physics gives."""

    name = "interreflection"
    measure = ABSOLUTE
    needs = Needs(steep=True, low_sun=True, bright_law=True)

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 3.0, 0.3, 9.5
        self.bounced: dict[int, Array] = {}

    def iof(self, pair: int, x: float) -> Array:
        if pair not in self.bounced:
            self.bounced[pair] = self._bounce(pair)
        return self.scene.plain(pair) + np.float32(x) * self.bounced[pair]

    def _bounce(self, pair: int) -> Array:
        """I/F of the fine window at strength 1, from irradiances on the grid of pixels."""
        scene = self.scene
        site = scene.pairs[pair][0]
        albedo = scene.law.at_30_degrees() / math.cos(math.pi / 6)
        height, gsd = scene.ground.pixels, scene.ground.gsd
        reach = scene.size // 2 + scene.margin
        row, col = scene.sites.row[site] - reach, scene.sites.col[site] - reach
        top, left = max(row - AROUND, 1), max(col - AROUND, 1)
        bottom = min(row + 2 * reach + AROUND, scene.sites.grid - 1)
        right = min(col + 2 * reach + AROUND, scene.sites.grid - 1)
        here = np.s_[top:bottom, left:right]
        gy, gx = np.gradient(height, gsd)
        gy = -gy
        sun = scene.geometry.sun[pair]
        mu0 = (-gx * sun[0] - gy * sun[1] + sun[2]) / np.sqrt(1 + gx * gx + gy * gy)
        horizon = np.zeros((bottom - top, right - left))
        horizontal = math.hypot(sun[0], sun[1])
        horizon_elevation(height, top, left, gsd, sun[0] / horizontal, sun[1] / horizontal, horizon)
        lit = horizon < math.degrees(math.asin(sun[2]))
        texture = block_mean(scene.ground.texture.astype(float), scene.ground.fine)
        exitance = np.zeros_like(height)
        exitance[here] = albedo * texture[here] * np.maximum(mu0[here], 0) * lit
        irradiance = np.zeros((2 * reach, 2 * reach))
        bounce(height, exitance, row, col, gsd, AZIMUTHS, FARTHEST, irradiance)
        fine = (albedo * refine(irradiance, scene.ground.fine, scene.window(site)[2])).astype(np.float32)
        return fine * scene.cut(scene.ground.texture, site)

    def parameters(self, x: float) -> dict:
        return {"strength": x}


class Earthshine(Plant):
    """A second, distant source: Lambert's law on the texture, without shadows."""

    name = "earthshine"
    measure = ABSOLUTE
    needs = Needs(low_sun=True)

    def draw(self, rng: np.random.Generator) -> None:
        level = self.scene.mean_iof
        self.start, self.low, self.high = 0.03 * level, 0.001 * level, 0.6 * level
        self.elevation, self.azimuth = rng.uniform(20, 75), rng.random() * 360
        self.alone: dict[int, Array] = {}

    def iof(self, pair: int, x: float) -> Array:
        plain = self.scene.plain(pair)
        if pair not in self.alone:
            towards = direction(math.radians(self.azimuth), math.radians(self.elevation))
            self.alone[pair] = self.scene.lit(pair, earth=np.array([1.0, *towards])) - plain
        return plain + np.float32(x) * self.alone[pair]

    def parameters(self, x: float) -> dict:
        return {"irradiance": x, "elevation_deg": self.elevation, "azimuth_deg": self.azimuth}


class Penumbra(Plant):
    name = "penumbra"
    measure = ABSOLUTE
    needs = Needs(steep=True, low_sun=True)
    start, low, high = 1.0, 0.35, 3.8

    def iof(self, pair: int, x: float) -> Array:
        return self.scene.lit(pair, radius_deg=x)

    def parameters(self, x: float) -> dict:
        return {"radius_deg": x}


class DistantShadow(Plant):
    """A ridge outside the DEM, on the side of the lowest Sun and high enough to shade part of its images."""

    name = "distant_shadow"
    measure = ABSOLUTE
    needs = Needs(low_sun=True)
    start, low, high = 1.0, 0.2, 6.0

    def draw(self, rng: np.random.Generator) -> None:
        scene, gsd = self.scene, self.scene.ground.gsd
        lowest = int(np.argmin(scene.sky.elevation))
        azimuth = scene.sky.azimuth[lowest] % 360
        self.side = int(((90 - azimuth + 45) % 360) // 90)
        self.distance = (scene.size / 2 + rng.uniform(6, 30)) * gsd
        self.phase = rng.random() * 6
        reach = scene.size * 0.25 + (self.distance / gsd - scene.size / 2)
        self.height = math.tan(math.radians(scene.sky.elevation[lowest])) * reach * gsd

    def iof(self, pair: int, x: float) -> Array:
        ridge = [1.0, self.side, self.distance, x * self.height, self.phase, self.scene.ground.gsd]
        return self.scene.lit(pair, ridge=np.array(ridge))

    def parameters(self, x: float) -> dict:
        from_border = self.distance - self.scene.size / 2 * self.scene.ground.gsd
        return {"height_m": x * self.height, "side": SIDES[self.side], "distance_from_border_m": from_border}


class OfLaw(Plant):
    """The law times a departure: see `laws.departed`."""

    width = 0.06  # of a surge
    parameter = ""
    slot = 0

    def in_law(self, x: float) -> float:
        return self.sign * x

    def iof(self, pair: int, x: float) -> Array:
        departure = np.zeros(6)
        departure[3], departure[5] = self.width, math.radians(45)
        departure[self.slot] = self.in_law(x)
        return self.scene.lit(pair, departure=departure)

    def parameters(self, x: float) -> dict:
        return {self.parameter: self.sign * x}


class PhaseSlope(OfLaw):
    name, parameter, slot = "phase_slope", "per_radian", 4
    measure = GAINS
    start, low, high = 0.15, 0.01, 2.0


class OppositionSurge(OfLaw):
    name, slot = "opposition_surge", 2
    measure = GAINS
    needs = Needs(oblique_share=0.6)

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high, self.sign = 0.6, 0.05, 3.5, 1.0
        self.width = rng.uniform(0.04, 0.12)

    def parameters(self, x: float) -> dict:
        return {"B0": x, "h": self.width}


class LimbDarkening(OfLaw):
    """The law times (1 - share) + share 2 / (mu0 + mu), the factor that turns Lambert's disc function into Lommel-Seeliger's."""

    name, parameter, slot = "limb_darkening", "share", 0
    needs = Needs(oblique_share=0.6)

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 0.15, log_uniform(rng, 0.02, 0.1), 0.95


class MacroscopicRoughness(OfLaw):
    name, parameter, slot = "macroscopic_roughness", "theta_bar_deg", 1
    needs = Needs(oblique_share=0.6, no_hapke=True)  # Hapke's law has it already

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high, self.sign = 15.0, log_uniform(rng, 6, 14), 42.0, 1.0

    def in_law(self, x: float) -> float:
        return math.radians(x)


class AzimuthalAnisotropy(Plant):
    """A gain by the Sun's azimuth, in half of the draws growing as its elevation falls."""

    name = "azimuthal_anisotropy"
    measure = GAINS
    start, low, high = 0.03, 0.002, 0.25

    def draw(self, rng: np.random.Generator) -> None:
        azimuth = rng.random() * 2 * np.pi
        self.towards = (math.sin(azimuth), math.cos(azimuth))
        self.shading = int(rng.choice([0, 1]))
        suns = self.scene.geometry.sun
        self.mean_cotangent = float(np.mean([1 / math.tan(math.asin(sun[2])) for sun in suns]))

    def iof(self, pair: int, x: float) -> Array:
        sun = self.scene.geometry.sun[pair]
        horizontal = math.hypot(sun[0], sun[1])
        aligned = (self.towards[0] * sun[0] + self.towards[1] * sun[1]) / horizontal
        gain = 1 + x * aligned * ((horizontal / sun[2]) / self.mean_cotangent) ** self.shading
        return self.scene.plain(pair) * np.float32(gain)

    def parameters(self, x: float) -> dict:
        return {"east": x * self.towards[0], "north": x * self.towards[1], "shading": self.shading}


OF_LAW = (PhaseSlope, OppositionSurge, LimbDarkening, MacroscopicRoughness, AzimuthalAnisotropy)
EFFECTS = (Interreflection, Earthshine, Penumbra, DistantShadow, *OF_LAW)
