"""Horizon angle by convex hulls: per line, the upper hull of the terrain ahead; per pixel, its tangent.

A point under the chord of two others can never be the horizon of anything behind it, so that a stack of hull points
per line, which every row pushes to, holds all that matters, and the horizon is the point where the sight line touches.
Terrain within ``NEAR`` rows is sampled along the pixel's own ray. Beyond, the slopes from the
pixel's own height to the highest points that the two neighbouring lines see are interpolated.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from stages.physics.horizon.sweeps import (
    FLAGS,
    NOTHING,
    PixelSize,
    Sweep,
    Taps,
    arctangent,
    compile_kernels,
    sink,
    strip_width,
    transpose_in,
    transpose_out,
)

NEAR = 16  # rows
NEAR_COLUMNS = 8  # rows within which crossings of columns count too
SPACING = 2  # columns from line to line
WINDOW = 12  # rows to either side that can hide a sample from everything behind
RING = 2 * WINDOW + 1
LINES = 1024  # lines per strip
BLOCK = 64  # columns per transposed block
SMALL = 512 * 512  # px; smaller grids are swept by the calling thread alone
NOWHERE = np.float32(1e30)  # row that stands for no point


@numba.njit(fastmath=FLAGS, error_model="numpy")
def _sample_lines(z, row, shift, z_column, first, lines, columns, f, lowered, out):
    """Heights where the lines cross one row, NOTHING outside the grid and beside NaN."""
    back = 1 if f > 0 else 0
    base = first - shift  # column right of line k is base + SPACING k
    lo = min(max(0, -((base - back) // SPACING)), lines)
    hi = max(min(lines, (columns - base + SPACING - 1) // SPACING), lo)
    out[:lo] = NOTHING
    out[hi:] = NOTHING
    one = np.float32(1.0)
    right = z[row, lo * SPACING + base - z_column : columns - z_column]
    left = z[row, lo * SPACING + base - back - z_column : columns - back - z_column]
    middle = out[lo:hi]
    for k in range(hi - lo):
        h = (one - f) * right[SPACING * k] + (f * left[SPACING * k] - lowered)
        middle[k] = h if h > NOTHING else NOTHING


@numba.njit(fastmath=FLAGS, error_model="numpy")
def _could_be_seen(samples, r, visible):
    """1 where row r of the samples stands above every chord between a nearer and a farther sample within WINDOW."""
    here = samples[r % RING]
    steepest, shallowest = samples[RING], samples[RING + 1]
    steepest[:] = NOTHING
    shallowest[:] = -NOTHING
    for a in range(1, WINDOW + 1):
        nearer, farther = samples[(r + a) % RING], samples[(r - a) % RING]
        d = np.float32(1 / a)
        for k in range(visible.size):
            rise = (nearer[k] - here[k]) * d
            fall = (here[k] - farther[k]) * d
            if rise > steepest[k]:
                steepest[k] = rise
            if fall < shallowest[k]:
                shallowest[k] = fall
    for k in range(visible.size):
        visible[k] = (steepest[k] < shallowest[k]) & (here[k] > NOTHING)


@numba.njit(fastmath=FLAGS, error_model="numpy")
def _push(hull, depth, s, heights, visible, chosen):
    """Add the nearest samples, row s, to the upper hulls of their lines; drop what the new chords hide."""
    count = 0
    for k in range(visible.size):  # a list of the few that are visible spares a mispredicted branch for each
        chosen[count] = k
        count += visible[k]
    for q in range(count):
        k = chosen[q]
        h = heights[k]
        p = depth[k] - 1
        while p > 0:
            if (hull[p - 1, k, 1] - h) * (s - hull[p, k, 0]) < (hull[p, k, 1] - h) * (s - hull[p - 1, k, 0]):
                break
            p -= 1
        p += 1
        hull[p, k, 0] = s
        hull[p, k, 1] = h
        depth[k] = p + 1


@numba.njit(fastmath=FLAGS, error_model="numpy")
def _find_tangents(hull, depth, s, heights, seen_s, seen_h):
    """Row and height of the highest terrain that each line sees from row s: along a hull slopes rise, then fall."""
    for k in range(depth.size):
        p = depth[k] - 1
        if p < 0:
            seen_s[k] = NOWHERE
            continue
        h = heights[k] if heights[k] > NOTHING else hull[p, k, 1]  # beside missing ground: from about there
        rise, run = hull[p, k, 1] - h, s - hull[p, k, 0]
        while p > 0:
            next_rise, next_run = hull[p - 1, k, 1] - h, s - hull[p - 1, k, 0]
            if next_rise * run <= rise * next_run:
                break
            rise, run = next_rise, next_run
            p -= 1
        seen_s[k] = hull[p, k, 0]
        seen_h[k] = hull[p, k, 1]


@numba.njit(fastmath=FLAGS, error_model="numpy")
def _horizon_rows(
    z, z_row, z_step, z_column, out, out_row, out_step, out_column, start, stop, first, count, sweep, taps, sinks,
    hull, depth, samples, visible, chosen, observers, seen_s, seen_h, angle,
):  # fmt: skip
    """Sweep rows start..stop of one strip of ``count`` lines from line ``first`` on.

    z[z_row + z_step * i, j - z_column] is pixel (i, j), and so for out. sinks : curvature, see ``sweeps.sink``
    hull : (rows, lines, 2) row and height of hull points, farthest first; depth : (lines,) points in use
    samples : (RING + 2, lines), the lines' heights over the last rows; the rest is scratch
    """
    whole, fraction, columns = sweep.whole, sweep.fraction, sweep.columns
    one = np.float32(1.0)
    lines = depth.size
    for i in range(start, stop):
        r = i - NEAR
        newest = r + WINDOW
        if newest >= 0:
            _sample_lines(
                z, z_row + z_step * newest, whole[newest], z_column, first, lines, columns, fraction[newest],
                np.float32(sink(sinks, float(newest))), samples[newest % RING],
            )  # fmt: skip
        if r >= 0:
            _could_be_seen(samples, r, visible)
            _push(hull, depth, np.float32(r), samples[r % RING], visible, chosen)
        here_sink = sink(sinks, float(i))
        j0, j1 = max(0, first - whole[i]), min(columns, first + count - whole[i])
        after = whole[min(i + 1, whole.size - 1)]
        soon = min(columns, first + count - after) > max(0, first - after)
        if r >= 0 and i % 2 == 0 and (j1 > j0 or soon):  # from 16 rows away, the next row sees the same points highest
            _sample_lines(
                z, z_row + z_step * i, whole[i], z_column, first, lines, columns, fraction[i], np.float32(here_sink),
                observers,
            )  # fmt: skip
            _find_tangents(hull, depth, np.float32(i), observers, seen_s, seen_h)
        if j1 <= j0:
            continue
        n = j1 - j0
        here = z[z_row + z_step * i, j0 - z_column : j1 - z_column]
        best = angle[:n]
        best[:] = -np.inf
        for tap in range(taps.distance.size):
            ra, rb = i - taps.rows[tap, 0], i - taps.rows[tap, 1]
            ca, cb = taps.columns[tap, 0], taps.columns[tap, 1]
            if rb < 0:
                break  # and so are all that follow
            lo = max(0, -(j0 + min(ca, cb)))
            hi = max(min(n, columns - j0 - max(ca, cb)), lo)
            w = taps.weight[tap]
            c = np.float32(here_sink - sink(sinks, i - taps.distance[tap]))
            d = np.float32(1 / taps.distance[tap])
            a = z[z_row + z_step * ra, lo + j0 + ca - z_column : hi + j0 + ca - z_column]
            b = z[z_row + z_step * rb, lo + j0 + cb - z_column : hi + j0 + cb - z_column]
            low, mine = best[lo:hi], here[lo:hi]
            if tap == 0 and sweep.shear != 0:
                side = 1 if sweep.shear > 0 else -1
                above = z[z_row + z_step * ra, lo + j0 - z_column : hi + j0 - z_column]
                corner = z[z_row + z_step * ra, lo + j0 + side - z_column : hi + j0 + side - z_column]
                next_to = z[z_row + z_step * i, lo + j0 + side - z_column : hi + j0 + side - z_column]
                half = np.float32(0.5 * abs(sweep.shear))
                for k in range(hi - lo):
                    h = (one - w) * a[k] + (w * b[k] + c) - mine[k]
                    bulge = half * ((next_to[k] + above[k]) - (mine[k] + corner[k]))
                    h += bulge if bulge > 0 else np.float32(0.0)
                    h *= d
                    if h > low[k]:
                        low[k] = h
            else:
                for k in range(hi - lo):
                    h = ((one - w) * a[k] + (w * b[k] + c) - mine[k]) * d
                    if h > low[k]:
                        low[k] = h
        if r >= 0:
            f = fraction[i]
            c, row_i = np.float32(here_sink), np.float32(i)
            at = j0 + whole[i] - first
            for phase in range(SPACING):
                # pixels whose left line is (at + phase) // SPACING, + 1 for every SPACING columns
                k0 = (at + phase) // SPACING
                g = ((at + phase) % SPACING + f) / np.float32(SPACING)
                left_s, left_h = seen_s[k0:], seen_h[k0:]
                right_s, right_h = seen_s[k0 + 1 :], seen_h[k0 + 1 :]
                low, z_here = best[phase:], here[phase:]
                for k in range((n - phase + SPACING - 1) // SPACING):
                    mine = z_here[SPACING * k] - c
                    left_slope = (left_h[k] - mine) / (row_i - left_s[k])
                    right_slope = (right_h[k] - mine) / (row_i - right_s[k])
                    no_left, no_right = left_s[k] == NOWHERE, right_s[k] == NOWHERE
                    left_slope = right_slope if no_left else left_slope
                    right_slope = left_slope if no_right else right_slope
                    far = left_slope + g * (right_slope - left_slope)
                    if far > low[SPACING * k] and not (no_left and no_right):
                        low[SPACING * k] = far
        scale, tilt = np.float32(1 / sweep.step), np.float32(-2 * sinks[0] * (i - sinks[1]) / sweep.step)
        result = out[out_row + out_step * i, j0 - out_column : j1 - out_column]
        for k in range(n):
            slope = best[k] * scale + tilt
            result[k] = arctangent(slope) if here[k] == here[k] else np.float32(np.nan)


@numba.njit
def _workspace(count, rows):
    """Hulls and scratch of one strip: hull, depth, samples, visible, chosen, observers, seen_s, seen_h, angle."""
    lines = (count + SPACING - 1) // SPACING + 1
    return (
        np.empty((rows + 1, lines // 16 * 16 + 24, 2), dtype=np.float32),  # an odd number of cache lines: no aliasing
        np.zeros(lines, dtype=np.int64),
        np.full((RING + 2, lines), NOTHING, dtype=np.float32),
        np.zeros(lines, dtype=np.bool_),
        np.empty(lines + 1, dtype=np.int64),
        np.empty(lines, dtype=np.float32),
        np.empty(lines, dtype=np.float32),
        np.empty(lines, dtype=np.float32),
        np.empty(count, dtype=np.float32),
    )


def _by_rows(z, row, step, out, stop, first_line, line_count, width, sweep, taps, sinks):
    """Sweep whose rows are the grid's rows, from ``row`` on in steps of ``step``: straight from the grid.

    Rows 0..stop over ``line_count`` lines from ``first_line`` on, in strips of ``width`` lines.
    """
    strips = (line_count + width - 1) // width
    for strip in numba.prange(strips):
        first = first_line + strip * width
        count = min(width, first_line + line_count - first)
        work = _workspace(count, stop)
        _horizon_rows(
            z, row, step, 0, out, row, step, 0, 0, stop, first, count, sweep, taps, sinks, *work,
        )  # fmt: skip


def _by_columns(z, column, step, out, stop, first_line, line_count, width, sweep, taps, sinks):
    """Sweep whose rows are the grid's columns, from ``column`` on: through blocks transposed into a buffer."""
    whole = sweep.whole
    strips = (line_count + width - 1) // width
    for strip in numba.prange(strips):
        first = first_line + strip * width
        count = min(width, first_line + line_count - first)
        work = _workspace(count, stop)
        margin = NEAR + 1
        pitch = count + BLOCK + 3 * margin + 2 * SPACING + 24
        rows = np.empty((BLOCK + margin, pitch), dtype=np.float32)
        angle = np.empty((BLOCK, pitch), dtype=np.float32)
        for begin in range(0, stop, BLOCK):
            end = min(begin + BLOCK, stop)
            from_row = max(begin - margin, 0)
            low, high = whole[from_row], whole[end - 1]
            if low > high:
                low, high = high, low
            j0 = max(0, first - high - margin - 1)
            j1 = min(sweep.columns, first + count + SPACING - low + margin + 1)
            if j1 <= j0:
                continue
            transpose_in(z, column + step * from_row, step, end - from_row, j0, j1, rows)
            _horizon_rows(
                rows, -from_row, 1, j0, angle, -begin, 1, j0, begin, end, first, count, sweep, taps, sinks, *work,
            )  # fmt: skip
            transpose_out(
                angle, j0, out, column, step, begin, end, whole, first, count,
                max(j0, first - high), min(j1, first + count - low),
            )  # fmt: skip


_KERNELS = compile_kernels(_by_rows, _by_columns)


def sweep_horizon(
    grid: NDArray[np.float32],
    gsd: PixelSize,
    azimuth: float,
    body_radius: float | None,
    target: tuple[int, int, int, int] | None = None,
) -> NDArray[np.float32]:
    """Elevation angle of the terrain horizon; see ``horizon.horizon``.

    grid : (H, W), m; gsd : m; azimuth : rad
    target : row, column, height, width of the part of the grid whose horizon is wanted (None: all of it)
    returns (height, width) float32, rad
    """
    sweep = Sweep.towards(azimuth, gsd, grid.shape)
    taps = Taps.near(sweep.shear, NEAR, NEAR_COLUMNS)
    row, column, height, width = target or (0, 0, *grid.shape)
    i0, i1, j0, j1 = (row, row + height, column, column + width)
    if sweep.by_columns:
        i0, i1, j0, j1 = j0, j1, i0, i1
    if sweep.reverse:
        i0, i1 = sweep.rows - i1, sweep.rows - i0
    shifts = sweep.whole[i0:i1]
    first_line = j0 + int(shifts.min(initial=0))
    line_count = j1 + int(shifts.max(initial=0)) - first_line
    out = np.empty(grid.shape, dtype=np.float32)
    parallel = grid.size > SMALL
    strip = -(-strip_width(line_count, LINES) // SPACING) * SPACING if parallel else line_count
    bend = 0.0 if body_radius is None else 0.5 * sweep.step**2 / body_radius
    origin, step = (sweep.rows - 1, -1) if sweep.reverse else (0, 1)
    _KERNELS[sweep.by_columns, parallel](
        grid, origin, step, out, i1, first_line, line_count, strip, sweep, taps, (bend, 0.5 * (sweep.rows - 1)),
    )  # fmt: skip
    return out[row : row + height, column : column + width]
