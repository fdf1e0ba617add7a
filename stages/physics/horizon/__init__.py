"""Terrain horizon and cast shadow of a height field, by scan-line sweeps that visit every pixel once.

Parallel rays towards the Sun are followed as a family of lines, one per pixel across the sweep. Along a line the
surface is known exactly where it crosses grid rows and grid columns, for every way of splitting a cell into triangles
and for the bilinear surface alike. Pixels lie between two lines; the two answers, both seen from the pixel's own
height, are interpolated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.errors import GeometryError
from stages.physics.horizon.hulls import sweep_horizon
from stages.physics.horizon.occluder import occluder_distance
from stages.physics.horizon.scene import Overview, horizon_in_scene, make_overview
from stages.physics.horizon.sweeps import PixelSize

__all__ = ["Overview", "cast_shadow", "horizon", "horizon_in_scene", "make_overview", "occluder_distance"]


def _check(
    shape: tuple[int, ...], gsd: PixelSize, body_radius: float | None, azimuth: float, sun_elevation: float = 0.0
) -> None:
    if len(shape) != 2:
        raise GeometryError(f"elevation: expected a grid (rows, columns), found shape {shape}.")
    sizes = gsd if isinstance(gsd, tuple) else (gsd,)
    if len(sizes) > 2 or not all(math.isfinite(size) and size > 0 for size in sizes):
        raise GeometryError(f"gsd: expected a pixel size in metres above 0, found {gsd}.")
    if body_radius is not None and not body_radius > 0:
        raise GeometryError(f"body_radius: expected metres above 0 or None, found {body_radius}.")
    if not math.isfinite(azimuth):
        raise GeometryError(f"azimuth: expected radians, found {azimuth}.")
    if not abs(sun_elevation) <= math.pi / 2 + 1e-6:
        raise GeometryError(f"sun_elevation: expected radians between -pi/2 and pi/2, found {sun_elevation}.")


def horizon(
    elevation: ArrayLike, gsd: PixelSize, azimuth: float, body_radius: float | None = None
) -> NDArray[np.float32]:
    """Elevation angle of the highest terrain in one azimuth, seen from every pixel's surface point.

    elevation : (H, W), m; NaN = nothing there; rows run south
    gsd : m per pixel, or (from row to row, from column to column) where pixels are not square on the ground, as on
        equirectangular maps (``Grid.local_frames(...).pixel_size``); azimuth : rad, clockwise from the grid's north
    body_radius : m; terrain at distance d sinks by d^2 / 2R (None: flat)
    returns (H, W) float32, rad: -pi/2 where no terrain lies in that azimuth, NaN where the elevation is NaN
    """
    grid = np.ascontiguousarray(elevation, dtype=np.float32)
    _check(grid.shape, gsd, body_radius, azimuth)
    return sweep_horizon(grid, gsd, azimuth, body_radius)


def cast_shadow(
    elevation: ArrayLike, gsd: PixelSize, azimuth: float, sun_elevation: float, body_radius: float | None = None
) -> NDArray[np.bool_]:
    """Where terrain hides the Sun's centre: its horizon stands above the Sun.

    elevation : (H, W), m; NaN = nothing there; rows run south
    gsd : m per pixel, one number or two as in :func:`horizon`
    azimuth, sun_elevation : rad, azimuth clockwise from the grid's north
    body_radius : m; the Sun's rays are then parallel in space: ``sun_elevation`` holds at the grid's centre and grows
        towards the Sun by 1 rad per radius (None: flat, the same everywhere)
    returns (H, W) bool, True = in shadow; False where the elevation is NaN
    """
    grid = np.ascontiguousarray(elevation, dtype=np.float32)
    _check(grid.shape, gsd, body_radius, azimuth, sun_elevation)
    sun = np.float32(sun_elevation)
    if body_radius is not None:
        south, east = gsd if isinstance(gsd, tuple) else (gsd, gsd)
        rows, columns = (np.arange(size, dtype=np.float32) - (size - 1) / 2 for size in grid.shape)
        towards = columns * east * math.sin(azimuth) - rows[:, None] * south * math.cos(azimuth)
        sun = np.arctan(math.tan(sun_elevation) + towards / body_radius).astype(np.float32)
    return sweep_horizon(grid, gsd, azimuth, body_radius) > sun
