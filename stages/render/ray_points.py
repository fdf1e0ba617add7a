"""What rays find where they meet a height field: normals, photometric angles and samples of maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from stages.common.arrays import Floats, Floats32
from stages.physics.terrain.block_geometry import slope_difference
from stages.render.chart import chart_gradient
from stages.render.raycast import HeightField, Hits, turn


def hit_points(hits: Hits, origins: Floats, directions: Floats) -> Floats:
    """(N, 3) body-fixed points where the rays met the surface, NaN where they did not."""
    return np.atleast_2d(origins) + hits.depth[:, None] * directions


@dataclass(frozen=True)
class HitAngles:
    """Per hit (N,) float32, NaN where there is none: cosines of incidence and emission, phase, the Sun's elevation, rad."""

    cos_incidence: Floats32
    cos_emission: Floats32
    phase: Floats32
    sun_elevation: Floats32


def hit_angles(field: HeightField, origins: Floats, directions: Floats, hits: Hits, sun_position: Floats) -> HitAngles:
    """Photometric angles where rays met the surface.

    The normal there is interpolated between central differences at the four pixels around, as a mesh with vertex
    normals would have it. sun_position : (3,), body-fixed, m
    """
    chart = field.chart
    out = np.empty((4, len(directions)), np.float32)
    _angles(
        field.elevation, chart.forward, chart.scale, chart.axes, np.ascontiguousarray(np.atleast_2d(origins)),
        np.ascontiguousarray(directions), hits.depth, hits.row, hits.col, chart.to_local(sun_position), out,
    )  # fmt: skip
    return HitAngles(*out)


@numba.njit(cache=True)
def _normal(z, forward, scale, x, y, w, row, col):
    """Unit normal at the local point (x, y, w) over (row, col)."""
    height, width = z.shape
    i = min(max(int(math.floor(col)), 0), width - 2)
    j = min(max(int(math.floor(row)), 0), height - 2)
    u, v = col - i, row - j
    slope_col, slope_row = 0.0, 0.0
    for dj in range(2):
        for di in range(2):
            r, c = j + dj, i + di
            weight = (u if di else 1.0 - u) * (v if dj else 1.0 - v)
            here = float(z[r, c])
            west = float(z[r, c - 1]) if c > 0 else np.nan
            east = float(z[r, c + 1]) if c < width - 1 else np.nan
            north = float(z[r - 1, c]) if r > 0 else np.nan
            south = float(z[r + 1, c]) if r < height - 1 else np.nan
            slope_col += weight * slope_difference(west, here, east)
            slope_row += weight * slope_difference(north, here, south)
    gx, gy = x / w, y / w
    col_x, col_y, row_x, row_y = chart_gradient(forward, gx / scale, gy / scale)
    # dh / d(gnomonic), then the gnomonic coordinates' own gradient in space
    hx = (slope_col * col_x + slope_row * row_x) / scale
    hy = (slope_col * col_y + slope_row * row_y) / scale
    inverse = 1.0 / math.sqrt(x * x + y * y + w * w)
    nx = x * inverse - hx / w
    ny = y * inverse - hy / w
    nw = w * inverse + (hx * gx + hy * gy) / w
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nw * nw)
    return nx * norm, ny * norm, nw * norm


@numba.njit(cache=True, parallel=True)
def _angles(z, forward, scale, axes, origins, directions, depth, row, col, sun, out):
    stride = 0 if origins.shape[0] == 1 else 1
    for n in numba.prange(directions.shape[0]):
        if depth[n] != depth[n]:
            out[0, n], out[1, n], out[2, n], out[3, n] = np.nan, np.nan, np.nan, np.nan
            continue
        ox, oy, oz = turn(axes, origins[n * stride])
        dx, dy, dz = turn(axes, directions[n])
        x, y, w = ox + depth[n] * dx, oy + depth[n] * dy, oz + depth[n] * dz
        nx, ny, nw = _normal(z, forward, scale, x, y, w, row[n], col[n])
        sx, sy, sw = sun[0] - x, sun[1] - y, sun[2] - w
        norm = 1.0 / math.sqrt(sx * sx + sy * sy + sw * sw)
        sx, sy, sw = sx * norm, sy * norm, sw * norm
        out[0, n] = nx * sx + ny * sy + nw * sw
        out[1, n] = -(nx * dx + ny * dy + nw * dz)
        # half-angle form: exact near opposition
        difference = math.sqrt((sx + dx) ** 2 + (sy + dy) ** 2 + (sw + dz) ** 2)
        total = math.sqrt((sx - dx) ** 2 + (sy - dy) ** 2 + (sw - dz) ** 2)
        out[2, n] = 2.0 * math.atan2(difference, total)
        out[3, n] = math.asin(min(1.0, max(-1.0, (x * sx + y * sy + w * sw) / math.sqrt(x * x + y * y + w * w))))


def sample_maps(maps: Floats32, row: Floats, col: Floats) -> Floats32:
    """(C, N) bilinear samples of (C, H, W) maps; unknown pixels (NaN) carry no weight, all unknown is NaN.

    row, col : (N,) px, NaN where there is none
    """
    maps = np.ascontiguousarray(maps, np.float32)
    result = np.empty((maps.shape[0], len(row)), np.float32)
    _sample(maps, row, col, result)
    return result


@numba.njit(cache=True, parallel=True)
def _sample(maps, row, col, result):
    channels, height, width = maps.shape
    for n in numba.prange(row.shape[0]):
        if row[n] != row[n]:
            for k in range(channels):
                result[k, n] = np.nan
            continue
        i = min(max(int(math.floor(col[n])), 0), width - 2)
        j = min(max(int(math.floor(row[n])), 0), height - 2)
        u, v = col[n] - i, row[n] - j
        for k in range(channels):
            total, weights = 0.0, 0.0
            for dj in range(2):
                for di in range(2):
                    value = maps[k, j + dj, i + di]
                    if value == value:
                        weight = (u if di else 1.0 - u) * (v if dj else 1.0 - v)
                        total += weight * value
                        weights += weight
            result[k, n] = total / weights if weights > 1e-9 else np.nan
