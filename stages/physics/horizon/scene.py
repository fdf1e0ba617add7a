"""Terrain horizon of a small crop from the whole scene, with bounded memory: full resolution near, a pyramid far.

Near terrain is read in a strip towards the azimuth and swept exactly. Far terrain is sampled from a pyramid of block
means, at a cell size in proportion to the distance, so that the angular error stays below the Sun's disc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from schemas.errors import GeometryError
from stages.physics.horizon.hulls import sweep_horizon
from stages.physics.maps.grid import Grid
from stages.physics.maps.window import Window

OVERVIEW_PX = 2048  # the far terrain is kept in memory at no more than this many pixels a side
CELLS_PER_DISTANCE = 64  # a ridge with slopes of +-0.3 is then rounded by less than 0.1 deg
NODE = 4  # the far horizon is searched from every fourth pixel


@dataclass(frozen=True)
class Overview:
    """Block means of a scene at ``factor``, 2 ``factor``, 4 ``factor``... pixels, and its extremes.

    shape : rows, columns of the scene at full resolution
    cells : all levels one after the other, row by row, m, NaN where a whole block has no elevation
    starts, shapes : (L,) and (L, 2), where each level begins and its rows and columns
    highest : highest elevation of the scene, m
    near_px : distance up to which the terrain must be read at full resolution
    """

    factor: int
    shape: tuple[int, int]
    cells: NDArray[np.float32]
    starts: NDArray[np.int64]
    shapes: NDArray[np.int64]
    highest: float
    near_px: int


def make_overview(elevation: Any, factor: int = 4, rows_at_once: int = 1024) -> Overview:
    """Reduce a scene once, streaming over rows.

    elevation : anything with ``shape`` and [r0:r1, c0:c1] (array, h5py dataset), m, NaN = nothing there
    factor : px per cell of the finest level; memory is 4/3 * 4 bytes / factor^2 per pixel of the scene
    """
    if factor < 1:
        raise GeometryError(f"overview factor: expected 1 or more, found {factor}.")
    height, width = (int(n) for n in elevation.shape)
    base = np.full((-(-height // factor), -(-width // factor)), np.nan, dtype=np.float32)
    rows_at_once = max(1, rows_at_once // factor) * factor
    highest = -math.inf
    for row in range(0, height, rows_at_once):
        block = np.ascontiguousarray(elevation[row : min(row + rows_at_once, height), :], dtype=np.float32)
        top = _block_mean(block, factor, base[row // factor : -(-(row + block.shape[0]) // factor)])
        highest = max(highest, top)
    levels = [base]
    while min(levels[-1].shape) > 2 * CELLS_PER_DISTANCE:
        finer = levels[-1]
        coarser = np.full((-(-finer.shape[0] // 2), -(-finer.shape[1] // 2)), np.nan, dtype=np.float32)
        _block_mean(finer, 2, coarser)
        levels.append(coarser)
    shapes = np.array([level.shape for level in levels], dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]])
    return Overview(
        factor,
        (height, width),
        np.concatenate([v.ravel() for v in levels]),
        starts,
        shapes,
        highest,
        factor * CELLS_PER_DISTANCE,
    )


@dataclass(frozen=True)
class SceneTerrain:
    """A scene's terrain, near and far. elevation : (H, W) array or dataset on ``grid``, m, NaN = unknown"""

    elevation: Any
    grid: Grid
    overview: Overview

    @classmethod
    def of(cls, elevation: Any, grid: Grid) -> SceneTerrain:
        """With an overview of at most OVERVIEW_PX cells a side."""
        return cls(elevation, grid, make_overview(elevation, max(1, math.ceil(max(elevation.shape) / OVERVIEW_PX))))

    @cached_property
    def heights(self) -> tuple[float, float]:
        """Least and largest elevation, m: the largest is exact, the least that of block means less half the relief."""
        cells, highest = self.overview.cells[np.isfinite(self.overview.cells)], self.overview.highest
        low = float(cells.min()) if cells.size else 0.0
        return low - 0.5 * max(0.0, highest - low), highest

    def horizon(self, window: Window, azimuth: float, sun_elevation: float | None = None) -> NDArray[np.float32]:
        """:func:`horizon_in_scene` for a window of the scene."""
        grid = self.grid
        return horizon_in_scene(
            self.elevation,
            self.overview,
            window,
            grid.gsd,
            azimuth,
            sun_elevation=sun_elevation,
            body_radius=grid.radius,
        )


@numba.njit(cache=True)
def _block_mean(block, factor, out):
    """Means of factor x factor blocks over what is there; returns the highest value."""
    height, width = block.shape
    highest = -np.inf
    for a in range(out.shape[0]):
        for b in range(out.shape[1]):
            total, count = 0.0, 0
            for r in range(a * factor, min((a + 1) * factor, height)):
                for c in range(b * factor, min((b + 1) * factor, width)):
                    z = block[r, c]
                    if z == z:
                        total += z
                        count += 1
                        highest = max(highest, z)
            if count:
                out[a, b] = total / count
    return highest


def horizon_in_scene(
    elevation: Any,
    overview: Overview,
    window: Window,
    gsd: float,
    azimuth: float,
    sun_elevation: float | None = None,
    body_radius: float | None = None,
) -> NDArray[np.float32]:
    """Elevation angle of the highest terrain of the whole scene in one azimuth, for the pixels of one crop.

    elevation : (rows, columns) of the scene, anything that slices [r0:r1, c0:c1], m; NaN = nothing there
    overview : from :func:`make_overview`, of the same scene
    window : the crop's pixels on the scene's grid; gsd : m; azimuth : rad, clockwise from the grid's north
    sun_elevation : rad; terrain that is certain to stay 1 deg below it is not searched for (None: search everything)
    body_radius : m; terrain at distance d sinks by d^2 / 2R (None: flat)
    returns (height, width) float32, rad, as :func:`stages.physics.horizon.horizon`
    """
    row, col, height, width = window
    rows, columns = overview.shape
    if tuple(int(n) for n in elevation.shape) != overview.shape:
        raise GeometryError(
            f"overview: expected that of a scene of {tuple(elevation.shape)} pixels, found one of {overview.shape}."
        )
    if row < 0 or col < 0 or height < 1 or width < 1 or row + height > rows or col + width > columns:
        raise GeometryError(
            f"crop: expected to lie within the scene of {rows} x {columns}, "
            f"found rows {row}..{row + height - 1}, columns {col}..{col + width - 1}."
        )
    east, north = math.sin(azimuth), math.cos(azimuth)
    reach_east = math.ceil(overview.near_px * abs(east) - 1e-6)
    reach_north = math.ceil(overview.near_px * abs(north) - 1e-6)
    top = max(0, row - reach_north) if north > 0 else row
    bottom = min(rows, row + height + reach_north) if north < 0 else row + height
    left = max(0, col - reach_east) if east < 0 else col
    right = min(columns, col + width + reach_east) if east > 0 else col + width
    strip = np.ascontiguousarray(elevation[top:bottom, left:right], dtype=np.float32)
    slope = np.tan(sweep_horizon(strip, gsd, azimuth, body_radius, (row - top, col - left, height, width)))
    slope[np.abs(slope) > 1e6] = -np.inf  # nothing there: float32's -pi/2 lies beyond the pole, its tangent is +2e7
    crop = strip[row - top : row - top + height, col - left : col - left + width]
    enough = -math.inf if sun_elevation is None else math.tan(max(sun_elevation - math.radians(1), -1.5))
    bend = 0.0 if body_radius is None else 0.5 / body_radius
    nodes = np.empty((-(-(height - 1) // NODE) + 1, -(-(width - 1) // NODE) + 1, 2), dtype=np.float32)
    _far_nodes(
        crop, overview.cells, overview.starts, overview.shapes, overview.factor, overview.highest,
        overview.near_px, row, col, east, north, gsd, bend, enough, slope, nodes,
    )  # fmt: skip
    _far_pixels(crop, nodes, east, north, gsd, bend, slope)
    return np.arctan(slope, out=slope)


@numba.njit(cache=True, error_model="numpy")
def _far_nodes(
    crop, cells, starts, shapes, factor, highest, near, row, col, east, north, gsd, bend, enough, slope, nodes
):  # fmt: skip
    """Distance and height of the far terrain that stands highest, seen from every NODE-th pixel (distance 0: none)."""
    height, width = crop.shape
    for a in range(nodes.shape[0]):
        for b in range(nodes.shape[1]):
            r, c = min(a * NODE, height - 1), min(b * NODE, width - 1)
            nodes[a, b, 0] = 0.0
            z = crop[r, c]
            # what no pixel around the node could see above its near horizon need not be found
            best = np.inf
            for m in range(max(0, r - NODE), min(height, r + NODE + 1)):
                for n in range(max(0, c - NODE), min(width, c + NODE + 1)):
                    if slope[m, n] < best:
                        best = slope[m, n]
                    if z != z:
                        z = crop[m, n]
            best = max(best, enough)
            if z != z or best == np.inf:
                continue
            distance = float(near)  # px
            while True:
                level = 0
                cell = factor
                while level + 1 < len(starts) and 2 * cell * CELLS_PER_DISTANCE <= distance:
                    level += 1
                    cell *= 2
                metres = distance * gsd
                fall = bend * metres * metres
                if (highest - fall - z) <= best * metres:
                    break  # nothing farther can stand higher
                y = (row + r - north * distance - 0.5 * (cell - 1)) / cell
                x = (col + c + east * distance - 0.5 * (cell - 1)) / cell
                if y < -0.5 or x < -0.5 or y > shapes[level, 0] - 0.5 or x > shapes[level, 1] - 0.5:
                    break
                y0, x0 = int(math.floor(y)), int(math.floor(x))
                fy, fx = y - y0, x - x0
                top, bottom = max(y0, 0), min(y0 + 1, shapes[level, 0] - 1)
                left, right = max(x0, 0), min(x0 + 1, shapes[level, 1] - 1)
                upper, lower = starts[level] + top * shapes[level, 1], starts[level] + bottom * shapes[level, 1]
                h = (1 - fy) * ((1 - fx) * cells[upper + left] + fx * cells[upper + right]) + fy * (
                    (1 - fx) * cells[lower + left] + fx * cells[lower + right]
                )
                if (h - fall - z) > best * metres:  # False for NaN
                    best = (h - fall - z) / metres
                    nodes[a, b, 0] = metres
                    nodes[a, b, 1] = h
                distance += cell


@numba.njit(cache=True, error_model="numpy")
def _far_pixels(crop, nodes, east, north, gsd, bend, slope):
    """Raise the near horizon to the far one: every pixel looks at what its four nodes found, from its own height."""
    height, width = crop.shape
    for r in range(height):
        a = min(r // NODE, nodes.shape[0] - 2) if nodes.shape[0] > 1 else 0
        for c in range(width):
            b = min(c // NODE, nodes.shape[1] - 2) if nodes.shape[1] > 1 else 0
            total, weight = 0.0, 0.0
            for m in range(a, min(a + 2, nodes.shape[0])):
                row = min(m * NODE, height - 1)
                wy = max(0.0, 1 - abs(r - row) / NODE)
                for n in range(b, min(b + 2, nodes.shape[1])):
                    column = min(n * NODE, width - 1)
                    w = wy * max(0.0, 1 - abs(c - column) / NODE)
                    if nodes[m, n, 0] > 0 and w > 0:
                        d = nodes[m, n, 0] + ((column - c) * east + (r - row) * north) * gsd
                        total += w * ((nodes[m, n, 1] - crop[r, c]) / d - bend * d)
                        weight += w
            if weight > 0.5 and total / weight > slope[r, c]:
                slope[r, c] = total / weight
