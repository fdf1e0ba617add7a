"""Cast shadow by a running shadow height: one maximum per pixel and line, vectorised across lines.

Along each line the highest ray that grazes the terrain so far sinks by the Sun's slope from row to row. A pixel lies in
shadow where that height, interpolated between its two lines, is above it. The interpolation is poorest close by, where
the foot of the pixel's ray and those of the lines differ most: terrain within ``NEAR`` rows is therefore sampled along the
pixel's own ray, and the lines carry only what lies beyond.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from stages.physics.horizon.sweeps import (
    FLAGS,
    NOTHING,
    PixelSize,
    Sweep,
    Taps,
    compile_kernels,
    sink,
    strip_width,
    transpose_in,
    transpose_out,
)

NEAR = 4  # rows; 2 rows double the disagreement with a ray tracer, 8 halve it again
LINES = 1024  # lines per strip: the rows in use then stay in the first-level cache
# columns per transposed block: 8 cache lines of elevation, 2 of shadow; all stays in the second-level cache
BLOCK = 128
SMALL = 512 * 512  # px; smaller grids are swept by the calling thread alone


@numba.njit(fastmath=FLAGS, inline="always")
def _raise_to(top, a, b, wa, wb, c):
    """top = max(top, wa a + wb b + c); a NaN changes nothing."""
    for k in range(top.size):
        h = wa * a[k] + (wb * b[k] + c)
        if h > top[k]:
            top[k] = h


@numba.njit(fastmath=FLAGS)
def _shadow_rows(
    z, z_row, z_step, z_column, out, out_row, out_step, out_column, start, stop, first, count,
    sweep, taps, drop, sinks, top, limit,
):  # fmt: skip
    """Sweep rows start..stop of one strip of ``count`` lines from line ``first`` on.

    z[z_row + z_step * i, j - z_column] is pixel (i, j), and so for out. sinks : curvature, see ``sweeps.sink``
    drop : m by which a ray towards the Sun sinks from row to row
    top : (count + 1,) highest ray over the lines as of row start - 1 - NEAR, updated; limit : (count,) scratch
    """
    whole, fraction, columns = sweep.whole, sweep.fraction, sweep.columns
    one = np.float32(1.0)
    fall = np.float32(drop)
    for i in range(start, stop):
        r = i - NEAR
        if r >= 0:
            base = first - whole[r]  # column right of line k is base + k
            f = fraction[r]
            lo = min(max(0, (1 if f > 0 else 0) - base), count + 1)
            hi = max(min(count + 1, columns - base), lo)
            u = sweep.crossing[r]
            if u > 0:
                cross = first - sweep.crossed[r]
                left, right = min(max(0, -cross), count + 1), min(count + 1, columns - cross)
                if right > left:
                    a = z[z_row + z_step * (r - 1), left + cross - z_column : right + cross - z_column]
                    b = z[z_row + z_step * r, left + cross - z_column : right + cross - z_column]
                    c = np.float32(u * fall - sink(sinks, r - 1 + u))
                    _raise_to(top[left:right], a, b, one - u, u, c)
            right_z = z[z_row + z_step * r, lo + base - z_column : hi + base - z_column]
            back = 1 if f > 0 else 0
            left_z = z[z_row + z_step * r, lo + base - back - z_column : hi + base - back - z_column]
            c = np.float32(sink(sinks, float(r)))
            for k in range(lo):
                top[k] -= fall
            middle = top[lo:hi]
            for k in range(hi - lo):
                h = (one - f) * right_z[k] + (f * left_z[k] - c)
                t = middle[k] - fall
                middle[k] = h if h > t else t
            for k in range(hi, count + 1):
                top[k] -= fall
        j0, j1 = max(0, first - whole[i]), min(columns, first + count - whole[i])
        if j1 <= j0:
            continue
        here_sink = sink(sinks, float(i))
        n = j1 - j0
        m = limit[:n]
        if r >= 0:
            f = fraction[i]
            at = j0 + whole[i] - first
            c = np.float32(here_sink - NEAR * drop)
            left_top, right_top = top[at : at + n], top[at + 1 : at + 1 + n]
            for k in range(n):
                m[k] = (one - f) * left_top[k] + (f * right_top[k] + c)
        else:
            m[:] = NOTHING
        here = z[z_row + z_step * i, j0 - z_column : j1 - z_column]
        for tap in range(taps.distance.size):
            ra, rb = i - taps.rows[tap, 0], i - taps.rows[tap, 1]
            ca, cb = taps.columns[tap, 0], taps.columns[tap, 1]
            if rb < 0:
                continue
            lo = max(0, -(j0 + min(ca, cb)))
            hi = max(min(n, columns - j0 - max(ca, cb)), lo)
            w, distance = taps.weight[tap], taps.distance[tap]
            c = np.float32(here_sink - sink(sinks, i - distance) - distance * drop)
            a = z[z_row + z_step * ra, lo + j0 + ca - z_column : hi + j0 + ca - z_column]
            b = z[z_row + z_step * rb, lo + j0 + cb - z_column : hi + j0 + cb - z_column]
            if tap == 0 and sweep.shear != 0:
                # the bilinear cell bulges over the chord by a quarter of its twist: seen from the pixel, twice that
                side = 1 if sweep.shear > 0 else -1
                above = z[z_row + z_step * ra, lo + j0 - z_column : hi + j0 - z_column]
                corner = z[z_row + z_step * ra, lo + j0 + side - z_column : hi + j0 + side - z_column]
                beside = z[z_row + z_step * i, lo + j0 + side - z_column : hi + j0 + side - z_column]
                half = np.float32(0.5 * abs(sweep.shear))
                low, mine = m[lo:hi], here[lo:hi]
                for k in range(hi - lo):
                    h = (one - w) * a[k] + (w * b[k] + c)
                    bulge = half * ((beside[k] + above[k]) - (mine[k] + corner[k]))
                    h += bulge if bulge > 0 else np.float32(0.0)
                    if h > low[k]:
                        low[k] = h
            else:
                _raise_to(m[lo:hi], a, b, one - w, w, c)
        result = out[out_row + out_step * i, j0 - out_column : j1 - out_column]
        for k in range(n):
            result[k] = here[k] < m[k]


def _by_rows(z, row, step, out, first_line, line_count, state, sweep, taps, drop, sinks):
    """Sweep whose rows are the grid's rows, from ``row`` on in steps of ``step``: straight from the grid."""
    strips, width = state.shape
    for strip in numba.prange(strips):
        first = first_line + strip * (width - 1)
        count = min(width - 1, first_line + line_count - first)
        limit = np.empty(count, dtype=np.float32)
        top = state[strip, : count + 1]
        _shadow_rows(
            z, row, step, 0, out, row, step, 0, 0, sweep.rows, first, count, sweep, taps, drop, sinks, top, limit,
        )  # fmt: skip


@numba.njit
def _pack(shade, n, low, high, reverse, packed):
    """Eight rows of flags side by side in one number, so that turning them back moves eight pixels at a time."""
    for g in range(n // 8):
        line = packed[g, low:high]
        line[:] = 0
        for q in range(8):
            shift = np.uint64(8 * (7 - q) if reverse else 8 * q)
            row = shade[8 * g + q, low:high]
            for k in range(high - low):
                line[k] |= np.uint64(row[k]) << shift


@numba.njit
def _unpack_column(packed, g, j, target):
    p = packed[g, j]
    for q in range(8):
        target[q] = np.uint8((p >> np.uint64(8 * q)) & np.uint64(255))


@numba.njit
def _turn_back(shade, packed, j0, out, column, step, begin, end, whole, first, count, low, high):
    """out[j, column + step * i] = shade[i - begin, j - j0] wherever pixel (i, j) belongs to the strip of lines."""
    n = end - begin
    _pack(shade, n, low - j0, high - j0, step < 0, packed)
    for j in range(low, high):
        if not (first <= j + whole[begin] < first + count and first <= j + whole[end - 1] < first + count):
            transpose_out(shade, j0, out, column, step, begin, end, whole, first, count, j, j + 1)
            continue
        for g in range(n // 8):
            at = column + step * (begin + 8 * g)
            _unpack_column(packed, g, j - j0, out[j, at : at + 8] if step > 0 else out[j, at - 7 : at + 1])
        for i in range(begin + n // 8 * 8, end):
            out[j, column + step * i] = shade[i - begin, j - j0]


def _by_columns(z, column, step, out, first_line, line_count, state, sweep, taps, drop, sinks):
    """Sweep whose rows are the grid's columns, from ``column`` on: through blocks transposed into a buffer."""
    whole = sweep.whole
    strips, width = state.shape
    for strip in numba.prange(strips):
        first = first_line + strip * (width - 1)
        count = min(width - 1, first_line + line_count - first)
        limit = np.empty(count, dtype=np.float32)
        top = state[strip, : count + 1]
        margin = NEAR + 1
        pitch = count + BLOCK + 3 * margin + 24
        rows = np.empty((BLOCK + margin, pitch), dtype=np.float32)
        shade = np.empty((BLOCK, pitch), dtype=np.bool_)
        packed = np.empty((BLOCK // 8, pitch), dtype=np.uint64)
        for begin in range(0, sweep.rows, BLOCK):
            end = min(begin + BLOCK, sweep.rows)
            from_row = max(begin - margin, 0)
            low, high = whole[from_row], whole[end - 1]
            if low > high:
                low, high = high, low
            j0 = max(0, first - high - margin - 1)
            j1 = min(sweep.columns, first + count + 1 - low + margin + 1)
            if j1 <= j0:
                for k in range(count + 1):
                    top[k] -= np.float32(drop * (end - begin))
                continue
            transpose_in(z, column + step * from_row, step, end - from_row, j0, j1, rows)
            _shadow_rows(
                rows, -from_row, 1, j0, shade, -begin, 1, j0, begin, end, first, count,
                sweep, taps, drop, sinks, top, limit,
            )  # fmt: skip
            _turn_back(
                shade, packed, j0, out, column, step, begin, end, whole, first, count,
                max(j0, first - high), min(j1, first + count - low),
            )  # fmt: skip


_KERNELS = compile_kernels(_by_rows, _by_columns)


def sweep_shadow(
    grid: NDArray[np.float32], gsd: PixelSize, azimuth: float, sun_elevation: float, body_radius: float | None
) -> NDArray[np.bool_]:
    """True where terrain hides a Sun at this azimuth and elevation (rad); see ``horizon.cast_shadow``.

    grid : (H, W), m; returns (H, W)
    """
    sweep = Sweep.towards(azimuth, gsd, grid.shape)
    taps = Taps.near(sweep.shear, NEAR, NEAR)
    drop = min(max(math.tan(sun_elevation), -1e9), 1e9) * sweep.step
    bend = 0.0 if body_radius is None else 0.5 * sweep.step**2 / body_radius
    out = np.empty(grid.shape, dtype=np.bool_)
    parallel = grid.size > SMALL
    first_line, lines = sweep.first_line, sweep.line_count
    width = strip_width(lines, LINES) if parallel else lines
    # (strips, width + 1), m: the highest ray over every line so far
    state = np.full((-(-lines // width), width + 1), NOTHING, dtype=np.float32)
    origin, step = (sweep.rows - 1, -1) if sweep.reverse else (0, 1)
    _KERNELS[sweep.by_columns, parallel](
        grid, origin, step, out.view(np.uint8) if sweep.by_columns else out, first_line, lines, state,
        sweep, taps, drop, (bend, 0.5 * (sweep.rows - 1)),
    )  # fmt: skip
    return out
