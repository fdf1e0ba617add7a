"""Scan-line sweeps of a height field along parallel rays: the kernels of ``horizon`` and ``cast_shadow``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

NOTHING = np.float32(-1e30)  # height of "no terrain": finite, so that interpolation with it stays below everything
BELOW = np.float32(-1e20)  # anything lower came from NOTHING


@dataclass(frozen=True)
class Sweep:
    """How a grid is turned so that the Sun stands beyond row 0, at a column slope between 0 and 1.

    The ray from (i, j) towards the Sun meets row i - 1 at column j + ``shear``; one row is ``step`` metres.
    """

    transpose: bool
    flip_rows: bool
    flip_columns: bool
    shear: float
    step: float

    @classmethod
    def towards(cls, azimuth: float, gsd: float) -> Sweep:
        east, north = math.sin(azimuth), math.cos(azimuth)
        transpose = abs(east) > abs(north)
        along, across = (
            (east, -north) if transpose else (-north, east)
        )  # towards higher rows, columns after transposing
        shear = abs(across / along)
        if shear < 1e-9:  # sin(pi) is not quite 0
            shear = 0.0
        return cls(transpose, along > 0, across < 0, shear, gsd * math.hypot(1.0, shear))

    def turn(self, grid: NDArray) -> NDArray:
        """A view of ``grid`` with the Sun beyond row 0 and to the right."""
        view = grid.T if self.transpose else grid
        return view[:: -1 if self.flip_rows else 1, :: -1 if self.flip_columns else 1]

    # turning back is the same two flips and one transpose in the other order
    def turn_back(self, grid: NDArray) -> NDArray:
        view = grid[:: -1 if self.flip_rows else 1, :: -1 if self.flip_columns else 1]
        return view.T if self.transpose else view


LINES = 128  # lines per strip: their running state stays in the first-level cache


@numba.njit(parallel=True, fastmath={"contract", "nsz", "arcp"}, cache=True)
def _shadow_sweep(z, shear, step, drop, bend, shadow):
    rows, columns = z.shape
    lines = columns + int(shear * (rows - 1)) + 1
    strips = (lines + LINES - 1) // LINES
    for strip in numba.prange(strips):
        first = strip * LINES
        top = np.full(LINES + 1, NOTHING, dtype=np.float32)  # height of the highest ray, where the line meets row i
        low = np.float32(NOTHING)
        fall = np.float32(drop)
        for i in range(rows):
            whole = int(shear * i)
            f = np.float32(shear * i - whole)
            sink = np.float32(bend * ((i - 0.5 * (rows - 1)) * step) ** 2)
            if i > 0:
                before = int(shear * (i - 1))
                u = np.float32(0.0)
                if whole > before and f > 0:
                    u = np.float32((whole - shear * (i - 1)) / shear)
                sink_u = np.float32(bend * ((i - 1 + u - 0.5 * (rows - 1)) * step) ** 2)
                for k in range(LINES + 1):
                    top[k] = top[k] - fall
                    column = first + k - whole
                    if u > 0 and 0 <= column < columns:
                        a, b = z[i - 1, column], z[i, column]
                        if a == a and b == b:
                            top[k] = max(top[k], (1 - u) * a + u * b - (1 - u) * fall - sink_u)
            for k in range(LINES):
                column = first + k - whole
                if 0 <= column < columns:
                    here = z[i, column] - sink
                    shadow[i, column] = here < (1 - f) * top[k] + f * top[k + 1]
            for k in range(LINES + 1):
                column = first + k - whole
                left = z[i, column - 1] if 0 < column <= columns else low
                right = z[i, column] if 0 <= column < columns else low
                if f == 0:
                    left = right
                height = (1 - f) * right + f * left - sink
                if height > top[k]:  # False for NaN
                    top[k] = height


@numba.njit(cache=True)
def _tangent(distance, height, count, i, z):
    """Steepest slope (per row) from (row i, height z) to the hull, walking from its nearest point outwards."""
    best = NOTHING
    for k in range(count - 1, -1, -1):
        slope = (height[k] - z) / (i - distance[k])
        if slope < best:
            break
        best = slope
    return best


@numba.njit(cache=True)
def _push(distance, height, count, i, z):
    """Add the nearest point to an upper hull; points under the new chord can never be seen again."""
    while count > 1:
        far = (height[count - 2] - z) * (i - distance[count - 1])
        near = (height[count - 1] - z) * (i - distance[count - 2])
        if far < near:
            break
        count -= 1
    distance[count] = i
    height[count] = z
    return count + 1


def _horizon_sweep(z, shear, step, bend, out):
    rows, columns = z.shape
    lines = columns + int(shear * (rows - 1)) + 1
    strips = (lines + LINES - 1) // LINES
    for strip in numba.prange(strips):
        first = strip * LINES
        distance = np.empty((LINES + 1, 2 * rows), dtype=np.float32)
        height = np.empty((LINES + 1, 2 * rows), dtype=np.float32)
        count = np.zeros(LINES + 1, dtype=np.int64)
        for i in range(rows):
            whole = int(shear * i)
            f = np.float32(shear * i - whole)
            offset = (i - 0.5 * (rows - 1)) * step
            sink = np.float32(bend * offset**2)
            before = int(shear * (i - 1)) if i > 0 else 0
            if whole > before and f > 0:
                u = np.float32((whole - shear * (i - 1)) / shear)
                sink_u = np.float32(bend * ((i - 1 + u - 0.5 * (rows - 1)) * step) ** 2)
                for k in range(LINES + 1):
                    column = first + k - whole
                    if 0 <= column < columns:
                        h = (1 - u) * z[i - 1, column] + u * z[i, column] - sink_u
                        if h == h:
                            count[k] = _push(distance[k], height[k], count[k], np.float32(i - 1 + u), h)
            for k in range(LINES):
                column = first + k - whole
                if 0 <= column < columns:
                    here = z[i, column] - sink
                    if here != here:
                        out[i, column] = np.nan
                        continue
                    slope = _tangent(distance[k], height[k], count[k], np.float32(i), here)
                    if f > 0:
                        right = _tangent(distance[k + 1], height[k + 1], count[k + 1], np.float32(i), here)
                        if right > BELOW:
                            slope = (1 - f) * slope + f * right if slope > BELOW else right
                    if slope > BELOW:
                        out[i, column] = slope / step - 2 * bend * offset
                    else:
                        out[i, column] = -np.inf
            for k in range(LINES + 1):
                column = first + k - whole
                h = np.float32(np.nan)
                if 0 <= column < columns:
                    h = z[i, column]
                    if f > 0:
                        h = (1 - f) * h + f * z[i, column - 1] if column > 0 else np.float32(np.nan)
                h -= sink
                if h == h:
                    count[k] = _push(distance[k], height[k], count[k], np.float32(i), h)


# small grids are swept by one thread: no start-up cost, and safe in worker processes and threads
_sweep_serial = numba.njit(cache=True)(_horizon_sweep)
_sweep_parallel = numba.njit(parallel=True, cache=True)(_horizon_sweep)


def horizon_slope(
    grid: NDArray[np.float32], gsd: float, azimuth: float, body_radius: float | None, parallel: bool
) -> NDArray[np.float32]:
    """Tangent of the horizon's elevation angle; -inf where nothing lies in that azimuth, NaN where the grid is NaN."""
    sweep = Sweep.towards(azimuth, gsd)
    turned = np.ascontiguousarray(sweep.turn(grid))
    bend = 0.0 if body_radius is None else 0.5 / body_radius
    slope = np.empty_like(turned)
    (_sweep_parallel if parallel else _sweep_serial)(turned, sweep.shear, sweep.step, bend, slope)
    return np.ascontiguousarray(sweep.turn_back(slope))


def shadow(
    grid: NDArray[np.float32], gsd: float, azimuth: float, sun_elevation: float, body_radius: float | None
) -> NDArray[np.bool_]:
    sweep = Sweep.towards(azimuth, gsd)
    turned = np.ascontiguousarray(sweep.turn(grid))
    bend = 0.0 if body_radius is None else 0.5 / body_radius
    out = np.empty(turned.shape, dtype=np.bool_)
    drop = min(max(math.tan(sun_elevation), -1e9), 1e9) * sweep.step
    _shadow_sweep(turned, sweep.shear, sweep.step, drop, bend, out)
    return np.ascontiguousarray(sweep.turn_back(out))
