"""The Sun's visible share over a map: the terrain horizon towards the Sun, in whole or block by block."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.physics.formation import sun_visibility
from stages.physics.grid import Grid
from stages.physics.horizon import horizon
from stages.physics.scene_horizon import Overview, horizon_in_scene, make_overview
from stages.physics.sun import Sun

WHOLE_PX = 32 << 20  # up to this many pixels one sweep over everything is cheaper than blocks
OVERVIEW_PX = 2048
BLOCK_PX = 1024


def visible_share(sun_elevation: NDArray, horizon: NDArray, radius: float) -> NDArray[np.float32]:
    """Share of the Sun above the horizon, 0..1, NaN where either is: the disc's formula only where the edge cuts it.

    sun_elevation, horizon : same shape, rad; radius : of the Sun, rad
    """
    height = sun_elevation - horizon
    share = (height > 0).astype(np.float32)
    share[np.isnan(height)] = np.nan
    cut = np.abs(height) < radius
    if cut.any():
        edge = torch.from_numpy(np.ascontiguousarray(height[cut]))
        share[cut] = sun_visibility(edge, torch.zeros_like(edge), radius).numpy()
    return share


class SunHorizon:
    """Elevation of the terrain horizon in the Sun's azimuth, for any window of a map.

    elevation : (H, W), anything that slices, m. One sweep serves the whole map where the Sun's azimuth hardly changes
    over it; larger maps are swept in blocks, each with the azimuth of its own middle, and see terrain from outside.
    """

    def __init__(self, elevation: Any, grid: Grid, sun: Sun, relief: float) -> None:
        self._elevation, self._grid, self._sun = elevation, grid, sun
        self._reference: NDArray[np.float32] | Overview
        if grid.height * grid.width <= WHOLE_PX and self._azimuth_is_even(relief):
            azimuth, _ = sun.over(grid, (grid.height - 1) / 2, (grid.width - 1) / 2)
            terrain = np.asarray(elevation[0 : grid.height, 0 : grid.width], np.float32)
            self._reference = horizon(terrain, grid.gsd, azimuth, grid.radius)
        else:
            factor = max(1, math.ceil(max(grid.height, grid.width) / OVERVIEW_PX))
            self._reference = make_overview(elevation, factor)

    def _azimuth_is_even(self, relief: float) -> bool:
        """Whether the azimuth at the middle displaces no shadow anywhere by more than a pixel."""
        grid = self._grid
        middle, elevation = self._sun.over(grid, (grid.height - 1) / 2, (grid.width - 1) / 2)
        reach = min(relief / math.tan(max(elevation, math.radians(1.0))), max(grid.height, grid.width) * grid.gsd)
        for row in (0, grid.height - 1):
            for col in (0, grid.width - 1):
                azimuth, _ = self._sun.over(grid, row, col)
                turn = math.remainder(azimuth - middle, 2 * math.pi)
                if abs(turn) * reach > grid.gsd:
                    return False
        return True

    def window(self, row: int, col: int, height: int, width: int) -> NDArray[np.float32]:
        """(height, width), rad, relative to the local horizontal; NaN where the elevation is."""
        if not isinstance(self._reference, Overview):
            return self._reference[row : row + height, col : col + width]
        result = np.empty((height, width), np.float32)
        for r in range(0, height, BLOCK_PX):
            for c in range(0, width, BLOCK_PX):
                h, w = min(BLOCK_PX, height - r), min(BLOCK_PX, width - c)
                azimuth, elevation = self._sun.over(self._grid, row + r + (h - 1) / 2, col + c + (w - 1) / 2)
                result[r : r + h, c : c + w] = horizon_in_scene(
                    self._elevation, self._reference, row + r, col + c, h, w, self._grid.gsd, azimuth,
                    sun_elevation=elevation, body_radius=self._grid.radius,
                )  # fmt: skip
        return result
