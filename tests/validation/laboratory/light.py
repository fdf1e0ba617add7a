"""Light on a height field: the Sun's disc behind the horizon, a ridge outside, earthshine, one bounce (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .laws import departed
from .resampling import bilinear

PI = math.pi
EAST, NORTH, WEST, SOUTH = 0, 1, 2, 3


@njit(cache=True, fastmath=True)
def disc_fraction(x: float) -> float:
    """Share of a disc of radius 1 above a straight horizon; x = (elevation of its centre - horizon) / radius."""
    if x >= 1.0:
        return 1.0
    if x <= -1.0:
        return 0.0
    return 0.5 + (math.asin(x) + x * math.sqrt(1 - x * x)) / PI


@njit(cache=True, fastmath=True)
def horizon_tangent(
    height: np.ndarray, r: float, c: float, dr: float, dc: float, dx: float, highest: float, least: float, grow: float
) -> float:
    """Tangent of the horizon's elevation from (r, c) towards (dr, dc), not below `least`.

    The step is one sample and grows by `grow` of the distance; the march ends where not even `highest` could rise above.
    """
    n, m = height.shape
    h0 = bilinear(height, r, c)
    best = least
    d = 1.0
    while True:
        rr = r + dr * d
        cc = c + dc * d
        if rr < 0 or cc < 0 or rr > n - 1 or cc > m - 1:
            break
        t = (bilinear(height, rr, cc) - h0) / (d * dx)
        if t > best:
            best = t
        if best > 0 and (highest - h0) < best * d * dx:
            break
        d += 1.0 + grow * d
    return best


@njit(cache=True, fastmath=True)
def ridge_tangent(ridge: np.ndarray, x: float, y: float, z: float, se: float, sn: float) -> float:
    """Tangent of the elevation of a ridge's wavy crest from (x, y, z) m towards the Sun's azimuth (se, sn); very low if not there.

    ridge: on, side (EAST ..), distance from the crop centre (m), height above it (m), phase of its waves, px (m).
    """
    side = int(ridge[1])
    if side == EAST:
        away = (ridge[2] - x) / max(se, 1e-6)
        along = y + away * sn
    elif side == NORTH:
        away = (ridge[2] - y) / max(sn, 1e-6)
        along = x + away * se
    elif side == WEST:
        away = (ridge[2] + x) / max(-se, 1e-6)
        along = y + away * sn
    else:
        away = (ridge[2] + y) / max(-sn, 1e-6)
        along = x + away * se
    if away <= 0:
        return -1e9
    waves = 0.12 * math.sin(along / (9 * ridge[5]) + ridge[4])
    crest = ridge[3] * (1 + waves + 0.06 * math.sin(along / (2.7 * ridge[5]) + 2 * ridge[4]))
    return (crest - z) / away


@njit(cache=True, fastmath=True)
def slopes(height: np.ndarray, a: int, b: int, dx: float) -> tuple[float, float, float]:
    """Slope to the east and to the north at a sample, and the vertical part of the unit normal."""
    gx = (height[a, b + 1] - height[a, b - 1]) / (2 * dx)
    gy = -(height[a + 1, b] - height[a - 1, b]) / (2 * dx)
    return gx, gy, 1.0 / math.sqrt(1 + gx * gx + gy * gy)


@njit(cache=True, fastmath=True)
def render(
    height: np.ndarray,
    texture: np.ndarray,
    r0: int,
    c0: int,
    dx: float,
    centre: np.ndarray,
    sun: np.ndarray,
    radius: float,
    camera: np.ndarray,
    code: int,
    p: np.ndarray,
    q: np.ndarray,
    ridge: np.ndarray,
    earth: np.ndarray,
    out: np.ndarray,
) -> None:
    """I/F of the window of `out` (rows, cols) that starts at (r0, c0) of the fine grid, whose samples are dx m apart.

    centre: row, column and height (m) of the crop's centre; sun: unit vector east, north, up; radius of its disc (rad); camera:
    position from the centre (m); code, p, q: see `laws.departed`; ridge: see `ridge_tangent`; earth: irradiance, unit vector.
    """
    horizontal = math.sqrt(sun[0] * sun[0] + sun[1] * sun[1])
    se = sun[0] / horizontal
    sn = sun[1] / horizontal
    elevation = math.atan2(sun[2], horizontal)
    least = math.tan(elevation - radius * 1.05)
    highest = height.max()
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            a = r0 + i
            b = c0 + j
            gx, gy, nn = slopes(height, a, b, dx)
            n0 = -gx * nn
            n1 = -gy * nn
            n2 = nn
            mu0 = n0 * sun[0] + n1 * sun[1] + n2 * sun[2]
            x = (b - centre[1]) * dx
            y = -(a - centre[0]) * dx
            z = height[a, b] - centre[2]
            v0 = camera[0] - x
            v1 = camera[1] - y
            v2 = camera[2] - z
            vn = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            v0 *= vn
            v1 *= vn
            v2 *= vn
            mu = n0 * v0 + n1 * v1 + n2 * v2
            if mu < 0.02:
                mu = 0.02
            value = 0.0
            if mu0 > 0.0:
                t = horizon_tangent(height, a, b, -sn, se, dx, highest, least, 0.015)
                if ridge[0] > 0:
                    t = max(t, ridge_tangent(ridge, x, y, z, se, sn))
                lit = disc_fraction((elevation - math.atan(t)) / radius)
                if lit > 0.0:
                    cg = v0 * sun[0] + v1 * sun[1] + v2 * sun[2]
                    g = math.acos(min(max(cg, -1.0), 1.0))
                    value = lit * departed(mu0, mu, g, code, p, q) * texture[a, b]
            if earth[0] != 0.0:
                me = n0 * earth[1] + n1 * earth[2] + n2 * earth[3]
                if me > 0:
                    value += earth[0] * me * texture[a, b]
            out[i, j] = value


@njit(cache=True, fastmath=True)
def horizon_elevation(
    height: np.ndarray, r0: int, c0: int, dx: float, east: float, north: float, out: np.ndarray
) -> None:
    """Elevation of the horizon (degrees) towards the azimuth (east, north), over the window of `out` from (r0, c0)."""
    highest = height.max()
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            t = horizon_tangent(height, r0 + i, c0 + j, -north, east, dx, highest, -1.0, 0.0)
            out[i, j] = math.degrees(math.atan(t))


@njit(cache=True, fastmath=True)
def bounce(
    height: np.ndarray, exitance: np.ndarray, r0: int, c0: int, dx: float, azimuths: int, farthest: int, out: np.ndarray
) -> None:
    """Irradiance from the terrain in sight, in the units of `exitance` (pi times its radiance), over the window of `out`.

    In each of `azimuths` directions the horizon is scanned outwards to `farthest` samples: whatever rises above what was seen
    before fills that band of elevation.
    """
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            a = r0 + i
            b = c0 + j
            gx, gy, nn = slopes(height, a, b, dx)
            total = 0.0
            for q in range(azimuths):
                az = 2 * PI * (q + 0.5) / azimuths
                e = math.sin(az)
                n = math.cos(az)
                best = math.atan(gx * e + gy * n)  # the tangent plane
                h0 = height[a, b]
                for d in range(1, farthest):
                    rr = a - n * d
                    cc = b + e * d
                    t = math.atan((bilinear(height, rr, cc) - h0) / (d * dx))
                    if t > best:
                        middle = 0.5 * (best + t)
                        ce = math.cos(middle)
                        cos_i = nn * (-gx * e * ce - gy * n * ce + math.sin(middle))
                        if cos_i > 0:
                            radiance = bilinear(exitance, rr, cc) / PI
                            total += radiance * cos_i * ce * (t - best) * (2 * PI / azimuths)
                        best = t
            out[i, j] = total
