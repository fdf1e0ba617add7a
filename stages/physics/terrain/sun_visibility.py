"""The Sun's visible share over a map: the terrain horizon towards the Sun, in whole or block by block."""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.physics.horizon import horizon
from stages.physics.horizon.scene import SceneTerrain, make_overview
from stages.physics.light.sun_disc import sun_visibility
from stages.physics.maps.grid import Grid
from stages.physics.maps.window import Window
from stages.physics.terrain.sun import Sun

WHOLE_PX = 32 << 20  # up to this many pixels one sweep over everything is cheaper than blocks
OVERVIEW_PX = 2048
BLOCK_PX = 1024
NEAR_FACTOR = 4  # terrain within 256 px is always swept at full resolution


def visible_share(sun_elevation: NDArray, horizon: NDArray, radius: float) -> NDArray[np.float32]:
    """Share of the Sun above the horizon, 0..1, NaN where either is; the disc's formula is used where the horizon cuts it.

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
        self._grid, self._sun = grid, sun
        self._reference: NDArray[np.float32] | SceneTerrain
        self._blocks: OrderedDict[tuple[int, int], NDArray[np.float32]] = OrderedDict()
        if grid.height * grid.width <= WHOLE_PX and self._azimuth_is_even(relief):
            azimuth, _ = sun.over(grid, (grid.height - 1) / 2, (grid.width - 1) / 2)
            terrain = np.asarray(elevation[0 : grid.height, 0 : grid.width], np.float32)
            self._reference = horizon(terrain, grid.gsd, azimuth, grid.radius)
        else:
            factor = max(NEAR_FACTOR, math.ceil(max(grid.height, grid.width) / OVERVIEW_PX))
            self._reference = SceneTerrain(elevation, grid, make_overview(elevation, factor))

    def _azimuth_is_even(self, relief: float) -> bool:
        """Whether taking the azimuth at the middle of the map for all of it displaces no shadow by more than a pixel."""
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
        if not isinstance(self._reference, SceneTerrain):
            return self._reference[row : row + height, col : col + width]
        result = np.empty((height, width), np.float32)
        for r in range(row - row % BLOCK_PX, row + height, BLOCK_PX):
            for c in range(col - col % BLOCK_PX, col + width, BLOCK_PX):
                block = self._block(self._reference, r, c)
                top, left = max(r, row), max(c, col)
                bottom, right = min(r + BLOCK_PX, row + height), min(c + BLOCK_PX, col + width)
                result[top - row : bottom - row, left - col : right - col] = block[
                    top - r : bottom - r, left - c : right - c
                ]
        return result

    def _block(self, terrain: SceneTerrain, row: int, col: int) -> NDArray[np.float32]:
        """One block of the map, kept until two rows of blocks have passed: bands of a map ask for it again."""
        if (row, col) not in self._blocks:
            height, width = min(BLOCK_PX, self._grid.height - row), min(BLOCK_PX, self._grid.width - col)
            azimuth, elevation = self._sun.over(self._grid, row + (height - 1) / 2, col + (width - 1) / 2)
            while len(self._blocks) >= 2 * (self._grid.width // BLOCK_PX + 1):
                self._blocks.popitem(last=False)
            self._blocks[row, col] = terrain.horizon(Window(row, col, height, width), azimuth, elevation)
        return self._blocks[row, col]
