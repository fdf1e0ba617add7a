"""The geometry of a scan-line sweep: how a height field is crossed by parallel rays towards the Sun.

A grid is swept from its Sun side, one grid row (or column, whichever the rays cross more steeply) after the other.
Seen that way the ray of pixel (i, j) meets row i - 1 at column j + shear, |shear| <= 1. Rays are followed as *lines*:
line l meets row i at column l - shear * i, so that pixel (i, j) lies between lines j + floor(shear * i) and the next.
Where a line crosses grid rows and grid columns the surface is linear between two pixels for either way of splitting
a cell into triangles and for the bilinear surface alike: a sweep uses those crossings only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

FLAGS = {"contract", "nsz", "arcp", "reassoc"}  # fast floats, but not "nnan": NaN marks where there is no terrain
PixelSize = float | tuple[float, float]  # m; a pair is (from row to row, from column to column)
NOTHING = np.float32(-1e30)  # height of "no terrain": finite, so that interpolation with it stays below everything


class Sweep(NamedTuple):
    """One sweep's orientation and, for every row, where lines and crossings are; numba kernels take it as it is.

    by_columns : rows of the sweep are the grid's columns
    reverse : row 0 of the sweep is the grid's last row (column)
    rows, columns : the grid's size as the sweep sees it
    shear : columns per row towards the Sun; step : m along the ray per row
    whole, fraction : (rows,) floor and fraction of shear * i
    crossing : (rows,) share of the way from row i - 1 to row i at which lines cross a grid column, 0 where they do not
    crossed : (rows,) line minus the column that is crossed there
    """

    by_columns: bool
    reverse: bool
    rows: int
    columns: int
    shear: float
    step: float
    whole: NDArray[np.int64]
    fraction: NDArray[np.float32]
    crossing: NDArray[np.float32]
    crossed: NDArray[np.int64]

    @classmethod
    def towards(cls, azimuth: float, gsd: PixelSize, shape: tuple[int, int]) -> Sweep:
        """azimuth : rad, clockwise from north; gsd : m; shape : (H, W) of the grid, rows run south."""
        south_size, east_size = gsd if isinstance(gsd, tuple) else (gsd, gsd)
        east, north = math.sin(azimuth) / east_size, math.cos(azimuth) / south_size  # px per m
        by_columns = abs(east) > abs(north)
        rows, columns = shape[::-1] if by_columns else shape
        shear = -north / abs(east) if by_columns else east / abs(north)
        if abs(shear) < 1e-9:  # sin(pi) is not quite 0
            shear = 0.0
        position = shear * np.arange(rows)
        nearest = np.rint(position)
        position = np.where(np.abs(position - nearest) < 1e-6, nearest, position)
        whole = np.floor(position)
        fraction = position - whole
        before, before_fraction = np.roll(whole, 1), np.roll(fraction, 1)
        crossed = whole if shear > 0 else before
        found = (whole > before) & (fraction > 0) if shear > 0 else (whole < before) & (before_fraction > 0)
        found[:1] = False
        crossing = np.zeros(rows)
        crossing[found] = crossed[found] / shear - (np.flatnonzero(found) - 1) if shear else 0.0
        return cls(
            by_columns,
            bool(east > 0 if by_columns else north < 0),
            rows,
            columns,
            shear,
            1 / max(abs(east), abs(north)),
            whole.astype(np.int64),
            fraction.astype(np.float32),
            crossing.astype(np.float32),
            crossed.astype(np.int64),
        )

    @property
    def first_line(self) -> int:
        """Number of the leftmost line."""
        return int(self.whole.min(initial=0))

    @property
    def line_count(self) -> int:
        """Lines that pass left of some pixel; every strip of lines follows one more, to the right of its last."""
        return self.columns + int(self.whole.max(initial=0)) - self.first_line


def strip_width(lines: int, aim: int) -> int:
    """Lines per strip, about ``aim``, so that every thread gets as many strips as the others."""
    threads = numba.get_num_threads()
    strips = -(-max(1, -(-lines // aim)) // threads) * threads
    return -(-lines // strips)


def compile_kernels(by_rows: Callable[..., None], by_columns: Callable[..., None]) -> dict[tuple[bool, bool], Any]:
    """(by columns, on all threads) -> the kernel of a sweep, cached on disk.

    Small grids are swept by the calling thread alone: no start-up cost, and safe in worker processes and threads.
    Numba's cache on disk tells functions apart by name and code, not by options, so that the kernel for all threads
    needs another name than the one for a single thread.
    """
    kernels = {}
    for columns, function in ((False, by_rows), (True, by_columns)):
        twin = FunctionType(function.__code__, function.__globals__, f"{function.__name__}_parallel")
        twin.__qualname__, twin.__module__ = twin.__name__, function.__module__
        kernels[columns, False] = numba.njit(cache=True)(function)
        kernels[columns, True] = numba.njit(parallel=True, cache=True)(twin)
    return kernels


class Taps(NamedTuple):
    """Where a pixel's own ray crosses grid rows and columns near the pixel, the same for all pixels (i, j) of a sweep.

    Tap t, ``distance[t]`` rows away, sees the height (1 - weight) z[i - rows[0], j + columns[0]] + weight z[i - rows[1],
    j + columns[1]]; rows, columns : (n, 2), weight, distance : (n,), all of them at t.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    weight: NDArray[np.float32]
    distance: NDArray[np.float64]

    @classmethod
    def near(cls, shear: float, reach: int, columns_reach: int) -> Taps:
        """Crossings of rows up to ``reach`` rows away and of columns up to ``columns_reach``, nearest first."""
        found: list[tuple[float, int, int, int, int, float]] = []
        for k in range(1, reach + 1):
            low, f = _split(k * shear)
            found.append((float(k), k, k, low, low + (f > 0), f))
        n = 1
        while shear and n / abs(shear) < columns_reach:
            low, f = _split(n / abs(shear))
            column = n if shear > 0 else -n
            if f > 0:
                found.append((n / abs(shear), low, low + 1, column, column, f))
            n += 1
        found.sort()
        table = np.array(found).reshape(-1, 6)
        return cls(
            table[:, 1:3].astype(np.int64),
            table[:, 3:5].astype(np.int64),
            table[:, 5].astype(np.float32),
            np.ascontiguousarray(table[:, 0]),
        )


def _split(value: float) -> tuple[int, float]:
    nearest = round(value)
    if abs(value - nearest) < 1e-6:
        return nearest, 0.0
    return math.floor(value), value - math.floor(value)


@numba.njit(inline="always")
def sink(sinks, i):
    """How far the body's curvature lowers row i (not only whole rows) below the plane at the sweep's middle, m."""
    d = i - sinks[1]
    return sinks[0] * d * d


@numba.njit
def transpose_in(z, column, step, n, j0, j1, rows):
    """rows[i, j] = z[j0 + j, column + step * i]"""
    if step > 0:
        for j in range(j1 - j0):
            source = z[j0 + j, column : column + n]
            for i in range(n):
                rows[i, j] = source[i]
    else:
        for j in range(j1 - j0):
            source = z[j0 + j, column - n + 1 : column + 1]
            for i in range(n):
                rows[n - 1 - i, j] = source[i]


@numba.njit
def transpose_out(shade, j0, out, column, step, begin, end, whole, first, count, low, high):
    """out[j, column + step * i] = shade[i - begin, j - j0] wherever pixel (i, j) belongs to the strip of lines."""
    for j in range(low, high):
        a, b = begin, end
        while a < b and not first <= j + whole[a] < first + count:
            a += 1
        while a < b and not first <= j + whole[b - 1] < first + count:
            b -= 1
        n = b - a
        if step > 0:
            target = out[j, column + a : column + b]
            for i in range(n):
                target[i] = shade[a - begin + i, j - j0]
        else:
            target = out[j, column - b + 1 : column - a + 1]
            for i in range(n):
                target[i] = shade[b - 1 - begin - i, j - j0]


@numba.njit(fastmath=FLAGS, inline="always", error_model="numpy")
def arctangent(x):
    """atan of a float32, vectorised: odd polynomial on [0, 1] fitted at Chebyshev nodes, error below 2e-7 rad."""
    one = np.float32(1.0)
    steep = abs(x) > one
    t = one / x if steep else x
    y = t * t
    p = np.float32(-0.004668773307318233)
    p = p * y + np.float32(0.02416618952121354)
    p = p * y + np.float32(-0.059367100787968426)
    p = p * y + np.float32(0.09906096895994193)
    p = p * y + np.float32(-0.1401658504206654)
    p = p * y + np.float32(0.19969235394797166)
    p = p * y + np.float32(-0.3333195972432464)
    p = p * y + np.float32(0.9999998977538574)
    p *= t
    quarter = np.float32(math.pi / 2)
    return ((quarter if x > 0 else -quarter) - p) if steep else p
