"""The truth's reflectance: an albedo that partly follows the ground and partly does not, as coefficient maps.

Follows the ground: young walls, rims and near ejecta are bright (not yet space-weathered), steep slopes are bright
(mass wasting uncovers fresh soil). Does not: rays from here and from far away, patches of other soil, a red texture.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from schemas.errors import RegistryError
from stages.common.arrays import Floats32
from stages.physics.photometry import ReflectanceModel, get_model
from stages.physics.relief.noise import fractal, gradient_noise
from stages.simulate.recipe import Config
from stages.simulate.terrain import Ground

MARGIN = 6  # DEM pixels around a block that slopes need
ALBEDO_PARAMETERS = ("w", "albedo", "single_scattering_albedo", "A", "normal_albedo")
# Relief below the DEM's pixel only is left to the roughness parameter; the albedo is a mare-highland border's.
PRESETS = {"hapke": {"w": 0.32, "theta": math.radians(16.0)}, "lunar_lambert": {"albedo": 0.13}}
# Sources of far rays: (distance from the centre over the scene's edge, azimuth in rad)
FAR_CRATERS = ((2.3, 2.1), (3.1, 5.3))


@njit(parallel=True, fastmath=True, cache=True)
def _far_rays(out, x0, y0, step, sx, sy, edge, seed):
    height, width = out.shape
    for r in prange(height):
        for c in range(width):
            dx, dy = x0 + c * step - sx, y0 - r * step - sy
            d = math.sqrt(dx * dx + dy * dy)
            ux, uy = dx / d, dy / d
            # a function of the azimuth, narrow in it, and patchy along the ray
            ray = gradient_noise(34.0 * ux, 34.0 * uy, seed) + 0.6 * gradient_noise(83.0 * ux, 83.0 * uy, seed + 1)
            patch = 0.6 + 1.4 * gradient_noise(9.0 * dx / edge, 9.0 * dy / edge, seed + 2)
            value = max(0.0, ray - 0.22) * 2.6 * max(0.0, patch)
            out[r, c] += np.float32(min(1.0, value))


def log_albedo(config: Config, ground: Ground, row: int) -> tuple[Floats32, Floats32]:
    """Natural logarithms of the albedo's two factors, (H, W) each: what follows the ground, and what does not.

    ground : rows of the scene with MARGIN pixels around them; row : the first of these rows
    """
    step = config.dem_gsd
    inner = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    elevation = ground.elevation
    k = max(1, min(MARGIN - 1, round(5.0 / step)))
    centre = elevation[inner]

    def shifted(dr: int, dc: int) -> Floats32:
        return elevation[MARGIN + dr : elevation.shape[0] - MARGIN + dr, MARGIN + dc : elevation.shape[1] - MARGIN + dc]

    east = (shifted(0, k) - shifted(0, -k)) / (2 * k * step)
    north = (shifted(-k, 0) - shifted(k, 0)) / (2 * k * step)
    slope = np.degrees(np.arctan(np.hypot(east, north)))
    wasting = np.clip((slope - 14.0) / 18.0, 0, 1)
    wasting = wasting * wasting * (3 - 2 * wasting)
    bend = (shifted(0, k) + shifted(0, -k) + shifted(k, 0) + shifted(-k, 0) - 4 * centre) / (k * step)
    geometry = 0.34 * ground.freshness[inner] + 0.24 * wasting - 0.05 * np.tanh(bend / 0.25)

    shape = centre.shape
    x0 = -config.extent / 2 + 0.5 * step
    y0 = config.extent / 2 - (row + 0.5) * step
    seed = config.seed * 11 + 5
    patches = fractal(shape, x0, y0, step, longest=3200.0, shortest=120.0, hurst=1.0, seed=seed)
    texture = fractal(shape, x0, y0, step, longest=260.0, shortest=2.5 * step, hurst=0.35, seed=seed + 1)
    far = np.zeros(shape, np.float32)
    for number, (distance, azimuth) in enumerate(FAR_CRATERS):
        sx, sy = config.extent * distance * math.sin(azimuth), config.extent * distance * math.cos(azimuth)
        _far_rays(far, x0, y0, step, sx, sy, max(config.extent, 5000.0), seed + 20 + number)
    free = 0.10 * np.tanh(1.3 * patches) + 0.018 * texture + 0.16 * far + 0.26 * np.tanh(ground.rays[inner])
    factors = config.geometry_contrast * geometry, config.free_contrast * free
    return factors[0].astype(np.float32), factors[1].astype(np.float32)


class Truth:
    """The reflectance model of a recipe and its parameters, constant or by place."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.model: ReflectanceModel = get_model(config.model)
        self._known = {p.name: p for p in self.model.parameters}
        for name in config.parameters:
            if name not in self._known:
                raise RegistryError.unknown(f"parameter of {self.model.name}", name, self._known)
        preset = PRESETS.get(self.model.name, {})
        self.constants: dict[str, float] = {**self.model.defaults(), **preset, **config.parameters}
        self.albedo_name = config.albedo_parameter or next((n for n in ALBEDO_PARAMETERS if n in self._known), "")
        if self.albedo_name not in self._known:
            raise RegistryError.unknown(f"albedo_parameter of {self.model.name}", self.albedo_name, self._known)
        # mature soil scatters back more strongly than fresh rock
        self.lobe_name = "b" if self.model.name.startswith("hapke") and "b" in self._known else ""

    @property
    def mapped(self) -> list[str]:
        """Names of the parameters that vary by place."""
        return [self.albedo_name, *filter(None, [self.lobe_name])]

    def maps(self, geometry: Floats32, free: Floats32) -> dict[str, Floats32]:
        """The parameters that vary by place, from the logarithms of the albedo's factors.

        geometry, free : (H, W); returns (H, W) by name
        """
        maps = {self.albedo_name: self._bounded(self.albedo_name, np.exp(geometry + free))}
        if self.lobe_name:
            maps[self.lobe_name] = self._bounded(self.lobe_name, 1 - 0.22 * np.tanh(geometry / 0.4))
        return maps

    def _bounded(self, name: str, factor: Floats32) -> Floats32:
        low, high = self._known[name].lower, self._known[name].upper
        margin = 1e-3 * (high - low)
        return np.clip(np.float32(self.constants[name]) * factor, low + margin, high - margin).astype(np.float32)
