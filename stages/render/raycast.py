"""Ray casting of a height field: the first point of a DEM's bilinear surface that a camera's ray meets.

The surface is exact (bilinear between pixel centres, on the curved body); a pyramid of maxima lets a ray skip what
lies wholly below it (Tevs, Ihrke, Seidel 2008, "Maximum mipmaps for fast, accurate, and scalable dynamic height field
rendering"). A ray is straight in space; in grid coordinates it is followed in short steps over which it is a straight
line whose height above the sphere is a parabola.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from schemas.errors import GeometryError
from stages.common.arrays import Floats, Floats32
from stages.physics.maps.grid import Grid
from stages.render.chart import Chart, chart_position, fit_chart, step_length

MISS, HIT, BELOW = 0, 1, 2  # a ray left the scene, met the surface, or came in under it (a hole or the scene's edge)
GOES_ON = -1


@dataclass(frozen=True)
class HeightField:
    """A DEM ready for rays.

    elevation : (H, W) float32, m above the sphere, NaN where unknown
    pyramid : maxima over 2^k x 2^k cells, k = 1.., one level after another; offsets, shapes : where each begins, its rows and columns
    lowest, highest : m; chart : from points in space to pixels; step : m along a ray, see ``chart.step_length``
    """

    elevation: Floats32
    pyramid: Floats32
    offsets: NDArray[np.int64]
    shapes: NDArray[np.int64]
    lowest: float
    highest: float
    chart: Chart
    step: float


@dataclass(frozen=True)
class Hits:
    """Where rays met the surface.

    status : (N,) uint8: MISS, HIT, BELOW
    depth : (N,), m along the ray, NaN where it met nothing; row, col : (N,), px on the grid
    """

    status: NDArray[np.uint8]
    depth: Floats
    row: Floats
    col: Floats


def build_height_field(elevation: Floats32, grid: Grid) -> HeightField:
    """Prepare a DEM for rays: one pass over it. Raises GeometryError where it holds no cell of four known heights.

    elevation : (H, W), m, NaN = unknown
    """
    elevation = np.ascontiguousarray(elevation, np.float32)
    height, width = elevation.shape
    if height < 2 or width < 2:
        raise GeometryError(f"a DEM of {height} x {width} px has no surface; expected at least 2 x 2 px.")
    shapes = [(height - 1, width - 1)]  # level 0: the patches between pixel centres
    while max(shapes[-1]) > 1:
        shapes.append(((shapes[-1][0] + 1) // 2, (shapes[-1][1] + 1) // 2))
    if len(shapes) == 1:
        shapes.append((1, 1))
    ends = np.cumsum([height * width for height, width in shapes[1:]])
    offsets = np.array([0, 0, *ends[:-1]], np.int64)  # level 0 is the elevation itself
    shape_array = np.array(shapes, np.int64)
    pyramid = np.empty(int(ends[-1]), np.float32)
    _build_first(elevation, pyramid, shape_array)
    for level in range(2, len(shapes)):
        _build_next(pyramid, offsets, shape_array, level)
    highest = float(pyramid[-1])
    if not math.isfinite(highest):
        raise GeometryError("the DEM holds no valid elevation where the camera looks; check its nodata.")
    lowest = float(np.nanmin(elevation))
    return HeightField(elevation, pyramid, offsets, shape_array, lowest, highest, fit_chart(grid), step_length(grid))


def cast(field: HeightField, origins: Floats, directions: Floats) -> Hits:
    """Follow rays to the surface.

    origins : (N, 3) or (1, 3), m, body-fixed; directions : (N, 3), body-fixed, unit
    """
    chart = field.chart
    count = len(directions)
    status = np.empty(count, np.uint8)
    depth, row, col = np.empty(count), np.empty(count), np.empty(count)
    _cast(
        field.elevation, field.pyramid, field.offsets, field.shapes, field.lowest, field.highest, chart.forward,
        chart.scale, chart.reach, chart.radius, field.step, chart.axes, np.ascontiguousarray(np.atleast_2d(origins)),
        np.ascontiguousarray(directions), status, depth, row, col,
    )  # fmt: skip
    return Hits(status, depth, row, col)


@numba.njit(cache=True, parallel=True)
def _build_first(z, pyramid, shapes):
    """Level 1: maxima over 2 x 2 patches, which are 3 x 3 heights. NaN counts as nothing."""
    height, width = z.shape
    rows, cols = shapes[1, 0], shapes[1, 1]
    for j in numba.prange(rows):
        for i in range(cols):
            best = np.float32(-np.inf)
            for r in range(2 * j, min(2 * j + 3, height)):
                for c in range(2 * i, min(2 * i + 3, width)):
                    if z[r, c] > best:
                        best = z[r, c]
            pyramid[j * cols + i] = best


@numba.njit(cache=True, parallel=True)
def _build_next(pyramid, offsets, shapes, level):
    rows, cols = shapes[level, 0], shapes[level, 1]
    below_rows, below_cols = shapes[level - 1, 0], shapes[level - 1, 1]
    source, target = offsets[level - 1], offsets[level]
    for j in numba.prange(rows):
        for i in range(cols):
            best = np.float32(-np.inf)
            for r in range(2 * j, min(2 * j + 2, below_rows)):
                for c in range(2 * i, min(2 * i + 2, below_cols)):
                    value = pyramid[source + r * below_cols + c]
                    if value > best:
                        best = value
            pyramid[target + j * cols + i] = best


@numba.njit(cache=True)
def _smallest_root(a, b, c, limit):
    """Smallest root of a t^2 + b t + c in [0, limit], or -1."""
    if c <= 0.0:
        return 0.0
    if abs(a) < 1e-300:
        if b >= 0.0:
            return -1.0
        t = -c / b
        return t if t <= limit else -1.0
    disc = b * b - 4.0 * a * c
    if disc < 0.0:
        return -1.0
    q = -0.5 * (b + math.copysign(math.sqrt(disc), b))
    first = q / a
    second = c / q if q != 0.0 else first
    if first > second:
        first, second = second, first
    if 0.0 <= first <= limit:
        return first
    if 0.0 <= second <= limit:
        return second
    return -1.0


@numba.njit(cache=True)
def _trace_step(z, pyramid, offsets, shapes, c0, r0, h0, c1, r1, h1, bulge, level, above):
    """One step of a ray over the grid, from (c0, r0, h0) to (c1, r1, h1), s = 0..1.

    bulge : m, how far the ray's height sags below the chord: h(s) = h0 + (h1 - h0) s - bulge s (1 - s)
    level : where in the pyramid to start; above : whether the ray is known to be above the surface
    returns (status, GOES_ON where it neither meets nor misses, s, level, above)
    """
    height, width = z.shape
    top = shapes.shape[0] - 1
    dc, dr = c1 - c0, r1 - r0
    # the part of the step that lies over the grid
    s, end = 0.0, 1.0
    if dc != 0.0:
        a, b = -c0 / dc, (width - 1 - c0) / dc
        s, end = max(s, min(a, b)), min(end, max(a, b))
    elif c0 < 0.0 or c0 > width - 1:
        return GOES_ON, 1.0, level, False
    if dr != 0.0:
        a, b = -r0 / dr, (height - 1 - r0) / dr
        s, end = max(s, min(a, b)), min(end, max(a, b))
    elif r0 < 0.0 or r0 > height - 1:
        return GOES_ON, 1.0, level, False
    if s >= end:
        return GOES_ON, 1.0, level, False
    if s > 0.0:
        above = False  # it comes in over the scene's edge here
    i = min(max(int(math.floor(c0 + dc * s)), 0), width - 2)
    j = min(max(int(math.floor(r0 + dr * s)), 0), height - 2)
    linear = h1 - h0 - bulge
    while True:
        size = 1 << level
        ci, cj = i >> level, j >> level
        sx, sy = np.inf, np.inf
        if dc > 0.0:
            sx = ((ci + 1) * size - c0) / dc
        elif dc < 0.0:
            sx = (ci * size - c0) / dc
        if dr > 0.0:
            sy = ((cj + 1) * size - r0) / dr
        elif dr < 0.0:
            sy = (cj * size - r0) / dr
        out = max(min(sx, sy, end), s)
        ha = h0 + (linear + bulge * s) * s
        hb = h0 + (linear + bulge * out) * out
        span = out - s
        low = min(ha, hb) - 0.25 * bulge * span * span
        if level > 0:
            if low <= pyramid[offsets[level] + cj * shapes[level, 1] + ci]:
                level -= 1
                continue
            above = True
        else:
            z00, z01, z10, z11 = z[j, i], z[j, i + 1], z[j + 1, i], z[j + 1, i + 1]
            if z00 + z01 + z10 + z11 != z00 + z01 + z10 + z11:
                above = False  # a hole: what happens in it is not known
            elif low > max(max(z00, z01), max(z10, z11)):
                above = True
            else:
                bx, by = float(z01) - z00, float(z10) - z00
                d = float(z00) - z01 - z10 + z11
                u, v = c0 + dc * s - i, r0 + dr * s - j
                c = ha - (z00 + bx * u + by * v + d * u * v)
                if c <= 0.0 and not above:
                    if c < -1e-6 * (1.0 + abs(ha)):
                        return BELOW, s, level, above
                    c = 0.0
                b = linear + 2.0 * bulge * s - (bx * dc + by * dr + d * (u * dr + v * dc))
                a = bulge - d * dc * dr
                t = _smallest_root(a, b, c, span)
                if t < 0.0 and (a * span + b) * span + c <= 0.0:
                    t = span
                if t >= 0.0:
                    return HIT, s + t, level, above
                above = True
        if out >= end:
            return GOES_ON, 1.0, level, above
        s = out
        if sx <= sy:
            i = (ci + 1) * size if dc > 0.0 else ci * size - 1
            j = min(max(int(math.floor(r0 + dr * s)), cj * size), (cj + 1) * size - 1, height - 2)
        else:
            j = (cj + 1) * size if dr > 0.0 else cj * size - 1
            i = min(max(int(math.floor(c0 + dc * s)), ci * size), (ci + 1) * size - 1, width - 2)
        if i < 0 or j < 0 or i > width - 2 or j > height - 2:
            return GOES_ON, 1.0, level, above
        if level < top:
            level += 1


@numba.njit(cache=True, parallel=True)
def _cast(
    z, pyramid, offsets, shapes, lowest, highest, forward, scale, reach, radius, step, axes, origins, directions,
    status, depth, row, col,
):  # fmt: skip
    stride = 0 if origins.shape[0] == 1 else 1
    for n in numba.prange(directions.shape[0]):
        status[n], depth[n], row[n], col[n] = _cast_one(
            z, pyramid, offsets, shapes, lowest, highest, forward, scale, reach, radius, step,
            turn(axes, origins[n * stride]), turn(axes, directions[n]),
        )  # fmt: skip


@numba.njit(cache=True, inline="always")
def turn(axes, v):
    """Body-fixed -> local, by hand: a matrix product of a million rows by 3 x 3 wakes threads for nothing."""
    return (
        axes[0, 0] * v[0] + axes[0, 1] * v[1] + axes[0, 2] * v[2],
        axes[1, 0] * v[0] + axes[1, 1] * v[1] + axes[1, 2] * v[2],
        axes[2, 0] * v[0] + axes[2, 1] * v[1] + axes[2, 2] * v[2],
    )


@numba.njit(cache=True)
def _cast_one(
    z, pyramid, offsets, shapes, lowest, highest, forward, scale, reach, radius, step, origin, direction
):  # fmt: skip
    """(status, depth, row, col) of one ray in the local frame."""
    ox, oy, oz = origin
    dx, dy, dz = direction
    # between the spheres through the highest and the lowest point
    b = ox * dx + oy * dy + oz * dz
    px, py, pz = ox - b * dx, oy - b * dy, oz - b * dz
    closest = px * px + py * py + pz * pz  # squared distance of the ray's line from the body's centre
    outer = (radius + highest + 0.01) ** 2 - closest
    if outer <= 0.0:
        return MISS, np.nan, np.nan, np.nan
    outer = math.sqrt(outer)
    t, last = max(-b - outer, 0.0), -b + outer
    inner = (radius + lowest - 0.01) ** 2 - closest
    if inner > 0.0 and -b - math.sqrt(inner) > 0.0:
        last = min(last, -b - math.sqrt(inner))
    if last <= t:
        return MISS, np.nan, np.nan, np.nan
    pieces = int(math.ceil((last - t) / step))
    length = (last - t) / pieces
    level, above = max(shapes.shape[0] - 3, 0), False
    known, c0, r0, h0 = False, 0.0, 0.0, 0.0
    for _ in range(pieces + 1):
        x, y, w = ox + t * dx, oy + t * dy, oz + t * dz
        inside = w > 0.0 and abs(x) <= reach * w and abs(y) <= reach * w
        c1, r1, h1 = 0.0, 0.0, 0.0
        if inside:
            c1, r1 = chart_position(forward, x / w / scale, y / w / scale)
            # |P| as hypotenuse of the closest distance and the distance along the ray keeps millimetres
            h1 = math.sqrt(closest + (b + t) * (b + t)) - radius
        if inside and known:
            middle = radius + 0.5 * (h0 + h1)
            bulge = 0.5 * length * length * closest / (middle * middle * middle)
            result, s, level, above = _trace_step(
                z, pyramid, offsets, shapes, c0, r0, h0, c1, r1, h1, bulge, level, above
            )
            if result == HIT:
                return HIT, t - length + s * length, r0 + (r1 - r0) * s, c0 + (c1 - c0) * s
            if result == BELOW:
                return BELOW, np.nan, np.nan, np.nan
        else:
            above = False
        known, c0, r0, h0 = inside, c1, r1, h1
        t += length
    return MISS, np.nan, np.nan, np.nan
