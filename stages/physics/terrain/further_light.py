"""Light besides the Sun's own: from the Earth, and from the lit terrain around (one bounce)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from stages.common.arrays import Floats, Floats32
from stages.physics.horizon.scene import make_overview
from stages.physics.light.earth import EARTH_RADIUS, earth_irradiance, earth_phase
from stages.physics.light.sky import Surroundings, terrain_light
from stages.physics.maps.window import Window
from stages.physics.photometry import lambert_albedo
from stages.physics.terrain.block_geometry import block_geometry
from stages.physics.terrain.sun import Sun
from stages.physics.terrain.sun_visibility import SunHorizon, visible_share
from stages.physics.terrain.surface import Surface

FINEST = 2  # px per cell of the map's means around a window
OVERVIEW_PX = 2048
BLOCK_PX = 1024


class Horizon(Protocol):
    """Elevation of the terrain horizon towards a source of light, rad, for any window of a map."""

    def window(self, row: int, col: int, height: int, width: int) -> Floats32:
        """(height, width) rad; NaN where the elevation is."""


class BelowHorizon:
    """The horizon over a map that hides a source of light everywhere."""

    def window(self, _row: int, _col: int, height: int, width: int) -> Floats32:
        """(height, width), rad."""
        return np.full((height, width), math.pi / 2, np.float32)


@dataclass(frozen=True)
class Earthshine:
    """The Earth's disc over a map, as a Sun that is ``irradiance`` times as bright. horizon : None = no shadows"""

    disc: Sun
    horizon: SunHorizon | None
    irradiance: float

    @staticmethod
    def over(surface: Surface, sun: Sun, earth_position: Floats, relief: float, shadows: bool) -> Earthshine:
        """The Earth at ``earth_position`` (3,), body-fixed, m, as lit by ``sun``. relief : m, lowest to highest point"""
        grid = surface.grid
        middle = grid.local_frames((grid.height - 1) / 2, (grid.width - 1) / 2).up[0] * grid.radius
        distance = float(np.linalg.norm(earth_position - middle))
        disc = Sun(earth_position, math.asin(EARTH_RADIUS / distance))
        horizon = SunHorizon(surface.elevation, grid, disc, relief) if shadows else None
        irradiance = float(earth_irradiance(earth_phase(sun.position, earth_position, middle), distance))
        return Earthshine(disc, horizon, irradiance)


def diffuse_albedo(surface: Surface, window: Window) -> Floats32:
    """Lambert albedo that reflects as much as the model does at incidence 30, emission 0 and phase 30 deg.

    returns (h, w) or (1, 1) where it is the same everywhere; NaN where the map is unknown
    """
    coefficients = torch.from_numpy(np.ascontiguousarray(surface.read_coefficients(*window)))
    value = lambert_albedo(surface.model, surface.model.unpack(coefficients, dim=0)).numpy()
    value[~np.isfinite(coefficients.numpy()).all(axis=0)] = np.nan
    return value


class _LitGround:
    """I/F of a map's sunlit facets as diffuse ones, computed window by window on slicing; NaN where unknown."""

    def __init__(self, surface: Surface, sun: Sun, horizon: Horizon | None) -> None:
        self._surface, self._sun, self._horizon = surface, sun, horizon
        self.shape = (surface.grid.height, surface.grid.width)

    def __getitem__(self, part: tuple[slice, slice]) -> Floats32:
        (top, bottom, _), (left, right, _) = (s.indices(n) for s, n in zip(part, self.shape, strict=True))
        result = np.empty((bottom - top, right - left), np.float32)
        for col in range(left, right, BLOCK_PX):
            width = min(BLOCK_PX, right - col)
            result[:, col - left : col - left + width] = self._block(Window(top, col, bottom - top, width))
        return result

    def _block(self, window: Window) -> Floats32:
        heights = self._surface.read_padded(*window, 1)
        geometry = block_geometry(self._surface.grid, window.row, window.col, heights, self._sun.position, None)
        lit = diffuse_albedo(self._surface, window) * np.maximum(geometry.cos_incidence, 0)
        if self._horizon is not None:
            lit = lit * visible_share(geometry.sun_elevation, self._horizon.window(*window), self._sun.radius)
        return lit


class Bounce:
    """Light from sunlit terrain to the terrain that sees it, one bounce between diffuse facets of the map's own albedo.

    Near terrain is taken pixel by pixel, far terrain from block means of the whole map, made once: memory stays bounded.
    """

    def __init__(self, surface: Surface, sun: Sun, horizon: Horizon | None) -> None:
        self._surface = surface
        self._lit = _LitGround(surface, sun, horizon)
        factor = max(FINEST, math.ceil(max(self._lit.shape) / OVERVIEW_PX))
        self._means = [make_overview(v, factor, rows_at_once=256) for v in (surface.elevation, self._lit)]

    def window(self, row: int, col: int, height: int, width: int) -> tuple[Floats32, Floats32]:
        """I/F to add and the sky view, (height, width) each; NaN where the map is unknown."""
        wanted, grid = Window(row, col, height, width), self._surface.grid
        around = wanted.padded(Surroundings.margin_px(self._means[0]), self._lit.shape)
        light, sky = terrain_light(
            self._surface.elevation[around.part],
            self._lit[around.part],
            grid.gsd,
            body_radius=grid.radius,
            inner=wanted.within(around),
            surroundings=Surroundings(self._means[0], self._means[1], around.row, around.col),
        )
        return light * diffuse_albedo(self._surface, wanted), sky
