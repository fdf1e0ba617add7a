"""Horizon angle by convex hulls: per line, the upper hull of the terrain ahead; per pixel, its tangent.

A point under the chord of two others can never be the horizon of anything behind it, so that a stack of hull points
per line, which every row pushes to, holds all that matters, and the horizon is the point where the sight line touches.
Like the cast shadow, the first ``NEAR`` rows are looked at along the pixel's own ray; beyond, what the two neighbouring
lines see highest is looked at from the pixel's own height, and the two slopes are interpolated.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from stages.physics.sweeps import FLAGS, Sweep, Taps, arctangent, sink, transpose_in, transpose_out

NEAR = 4  # rows
LINES = 256  # lines per strip
BLOCK = 64  # columns per transposed block
SMALL = 512 * 512  # px; smaller grids are swept by the calling thread alone
NOWHERE = np.float32(1e30)  # row of a point that is not there


@numba.njit(fastmath=FLAGS)
def _push(hull, count, s, h):
    """Add the nearest point so far, row s and height h, to an upper hull; drop what its chord hides."""
    while count > 1:
        near, far = hull[count - 1], hull[count - 2]
        if (far[1] - h) * (s - near[0]) < (near[1] - h) * (s - far[0]):
            break
        count -= 1
    hull[count, 0] = s
    hull[count, 1] = h
    return count + 1


@numba.njit(fastmath=FLAGS)
def _tangent(hull, count, s, h):
    """Index of the hull point that stands highest seen from row s, height h: slopes rise, then fall, going outwards."""
    k = count - 1
    rise, run = hull[k, 1] - h, s - hull[k, 0]
    while k > 0:
        next_rise, next_run = hull[k - 1, 1] - h, s - hull[k - 1, 0]
        if next_rise * run <= rise * next_run:
            break
        rise, run = next_rise, next_run
        k -= 1
    return k


@numba.njit(fastmath=FLAGS)
def _horizon_rows(
    z, z_row, z_step, z_column, out, out_row, out_step, out_column, start, stop, first, count, columns,
    whole, fraction, crossing, crossed, tap_rows, tap_columns, tap_weight, tap_distance, near, shear, step, sinks,
    hulls, depth, seen_s, seen_h, height, angle,
):  # fmt: skip
    """Sweep rows start..stop of one strip of lines; arguments as for the cast shadow's ``_shadow_rows``.

    hulls : (count + 1, 2 rows, 2) row and height of hull points; depth : (count + 1,) points in use
    seen_s, seen_h : (count + 1,) scratch: the point each line sees highest; height, angle : scratch
    """
    one = np.float32(1.0)
    for i in range(start, stop):
        r = i - near
        if r >= 0:
            base = first - whole[r]
            u = crossing[r]
            if u > 0:
                cross = first - crossed[r]
                lo, hi = min(max(0, -cross), count + 1), min(count + 1, columns - cross)
                if hi > lo:
                    a = z[z_row + z_step * (r - 1), lo + cross - z_column : hi + cross - z_column]
                    b = z[z_row + z_step * r, lo + cross - z_column : hi + cross - z_column]
                    s, c = np.float32(r - 1 + u), np.float32(sink(sinks, r - 1 + u))
                    for k in range(hi - lo):
                        height[k] = (one - u) * a[k] + (u * b[k] - c)
                    for k in range(hi - lo):
                        if height[k] == height[k]:
                            depth[lo + k] = _push(hulls[lo + k], depth[lo + k], s, height[k])
            f = fraction[r]
            back = 1 if f > 0 else 0
            lo = min(max(0, back - base), count + 1)
            hi = max(min(count + 1, columns - base), lo)
            a = z[z_row + z_step * r, lo + base - z_column : hi + base - z_column]
            b = z[z_row + z_step * r, lo + base - back - z_column : hi + base - back - z_column]
            s, c = np.float32(r), np.float32(sink(sinks, float(r)))
            for k in range(hi - lo):
                height[k] = (one - f) * a[k] + (f * b[k] - c)
            for k in range(hi - lo):
                if height[k] == height[k]:
                    depth[lo + k] = _push(hulls[lo + k], depth[lo + k], s, height[k])
        j0, j1 = max(0, first - whole[i]), min(columns, first + count - whole[i])
        if j1 <= j0:
            continue
        here_sink = sink(sinks, float(i))
        n = j1 - j0
        here = z[z_row + z_step * i, j0 - z_column : j1 - z_column]
        best = angle[:n]
        best[:] = -np.inf
        for tap in range(tap_distance.size):
            ra, rb = i - tap_rows[tap, 0], i - tap_rows[tap, 1]
            ca, cb = tap_columns[tap, 0], tap_columns[tap, 1]
            if rb < 0:
                continue
            lo = max(0, -(j0 + min(ca, cb)))
            hi = max(min(n, columns - j0 - max(ca, cb)), lo)
            w = tap_weight[tap]
            c = np.float32(here_sink - sink(sinks, i - tap_distance[tap]))
            d = np.float32(1 / tap_distance[tap])
            a = z[z_row + z_step * ra, lo + j0 + ca - z_column : hi + j0 + ca - z_column]
            b = z[z_row + z_step * rb, lo + j0 + cb - z_column : hi + j0 + cb - z_column]
            low, mine = best[lo:hi], here[lo:hi]
            if tap == 0 and shear != 0:
                side = 1 if shear > 0 else -1
                above = z[z_row + z_step * ra, lo + j0 - z_column : hi + j0 - z_column]
                corner = z[z_row + z_step * ra, lo + j0 + side - z_column : hi + j0 + side - z_column]
                next_to = z[z_row + z_step * i, lo + j0 + side - z_column : hi + j0 + side - z_column]
                half = np.float32(0.5 * abs(shear))
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
            # what each line sees highest from where it crosses row i
            row = z_row + z_step * i
            at = j0 + whole[i] - first
            for k in range(n + 1):
                seen_s[k] = NOWHERE
                if depth[at + k] == 0 or (k == n and f == 0):
                    continue
                right = here[k] if k < n else (z[row, j1 - z_column] if j1 < columns else np.float32(np.nan))
                left = here[k - 1] if k > 0 else (z[row, j0 - 1 - z_column] if j0 > 0 else np.float32(np.nan))
                if right != right:
                    right = left
                elif left != left:
                    left = right
                if right != right:
                    continue
                p = _tangent(
                    hulls[at + k], depth[at + k], np.float32(i), (one - f) * right + f * left - np.float32(here_sink)
                )
                seen_s[k] = hulls[at + k, p, 0]
                seen_h[k] = hulls[at + k, p, 1]
            c, row_i = np.float32(here_sink), np.float32(i)
            for k in range(n):
                mine = here[k] - c
                left_slope = (seen_h[k] - mine) / (row_i - seen_s[k])
                right_slope = (seen_h[k + 1] - mine) / (row_i - seen_s[k + 1])
                no_left, no_right = seen_s[k] == NOWHERE, seen_s[k + 1] == NOWHERE
                left_slope = right_slope if no_left else left_slope
                right_slope = left_slope if no_right else right_slope
                far = left_slope + f * (right_slope - left_slope)
                if far > best[k] and not (no_left and no_right):
                    best[k] = far
        scale, tilt = np.float32(1 / step), np.float32(-2 * sinks[0] * (i - sinks[1]) / step)
        result = out[out_row + out_step * i, j0 - out_column : j1 - out_column]
        for k in range(n):
            slope = best[k] * scale + tilt
            result[k] = arctangent(slope) if here[k] == here[k] else np.float32(np.nan)


def _by_rows(
    z, z_row, z_step, out, start, stop, columns, first_line, line_count, width,
    whole, fraction, crossing, crossed, tap_rows, tap_columns, tap_weight, tap_distance, near, shear, step, sinks,
):  # fmt: skip
    """Sweep whose rows are the grid's rows, over some of its lines: straight from the grid."""
    strips = (line_count + width - 1) // width
    for strip in numba.prange(strips):
        first = first_line + strip * width
        count = min(width, first_line + line_count - first)
        hulls = np.empty((count + 1, 2 * stop + 2, 2), dtype=np.float32)
        depth = np.zeros(count + 1, dtype=np.int64)
        scratch = np.empty((4, count + 1), dtype=np.float32)
        _horizon_rows(
            z, z_row, z_step, 0, out, z_row, z_step, 0, start, stop, first, count, columns,
            whole, fraction, crossing, crossed, tap_rows, tap_columns, tap_weight, tap_distance, near, shear, step,
            sinks, hulls, depth, scratch[0], scratch[1], scratch[2], scratch[3],
        )  # fmt: skip


def _by_columns(
    z, z_column, z_step, out, start, stop, columns, first_line, line_count, width,
    whole, fraction, crossing, crossed, tap_rows, tap_columns, tap_weight, tap_distance, near, shear, step, sinks,
):  # fmt: skip
    """Sweep whose rows are the grid's columns: through blocks transposed into a buffer."""
    strips = (line_count + width - 1) // width
    for strip in numba.prange(strips):
        first = first_line + strip * width
        count = min(width, first_line + line_count - first)
        hulls = np.empty((count + 1, 2 * stop + 2, 2), dtype=np.float32)
        depth = np.zeros(count + 1, dtype=np.int64)
        scratch = np.empty((4, count + 1), dtype=np.float32)
        margin = near + 1
        pitch = count + BLOCK + 3 * margin + 24
        rows = np.empty((BLOCK + margin, pitch), dtype=np.float32)
        angle = np.empty((BLOCK, pitch), dtype=np.float32)
        for begin in range(start, stop, BLOCK):
            end = min(begin + BLOCK, stop)
            from_row = max(begin - margin, 0)
            low, high = whole[from_row], whole[end - 1]
            if low > high:
                low, high = high, low
            j0 = max(0, first - high - margin - 1)
            j1 = min(columns, first + count + 1 - low + margin + 1)
            if j1 <= j0:
                continue
            transpose_in(z, z_column + z_step * from_row, z_step, end - from_row, j0, j1, rows)
            _horizon_rows(
                rows, -from_row, 1, j0, angle, -begin, 1, j0, begin, end, first, count, columns,
                whole, fraction, crossing, crossed, tap_rows, tap_columns, tap_weight, tap_distance, near, shear, step,
                sinks, hulls, depth, scratch[0], scratch[1], scratch[2], scratch[3],
            )  # fmt: skip
            transpose_out(
                angle, j0, out, z_column, z_step, begin, end, whole, first, count,
                max(j0, first - high), min(j1, first + count - low),
            )  # fmt: skip


# Small grids are swept by the calling thread alone: no start-up cost, and safe in worker processes and threads.
_KERNELS = {
    (columns, parallel): numba.njit(parallel=parallel, cache=True)(_by_columns if columns else _by_rows)
    for columns in (False, True)
    for parallel in (False, True)
}


def sweep_horizon(
    grid: NDArray[np.float32],
    gsd: float,
    azimuth: float,
    body_radius: float | None,
    target: tuple[int, int, int, int] | None = None,
) -> NDArray[np.float32]:
    """Elevation angle of the terrain horizon; see ``horizon.horizon``.

    target : row, column, height, width of the part of the grid whose horizon is wanted (None: all of it)
    """
    sweep = Sweep.towards(azimuth, gsd, grid.shape)
    taps = Taps.near(sweep.shear, NEAR)
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
    bend = 0.0 if body_radius is None else 0.5 * sweep.step**2 / body_radius
    origin, step = (sweep.rows - 1, -1) if sweep.reverse else (0, 1)
    _KERNELS[sweep.by_columns, parallel](
        grid, origin, step, out, 0, i1, sweep.columns, first_line, line_count, LINES if parallel else line_count,
        sweep.whole, sweep.fraction, sweep.crossing, sweep.crossed, taps.rows, taps.columns, taps.weight,
        taps.distance, NEAR, sweep.shear, sweep.step, (bend, 0.5 * (sweep.rows - 1)),
    )  # fmt: skip
    return out[row : row + height, column : column + width]
