"""Light that does not come straight from the Sun: how much sky a facet sees, and what the terrain around it sends.

Both integrate over azimuths. In one azimuth a facet with normal n sees elevations above a with the cosine-weighted share
F(a) = nz cos^2 a + nh (pi/2 - a - sin a cos a), nh the normal's component along the azimuth (Dozier and Frew 1990,
IEEE Trans. Geosci. Remote Sens. 28, 963, whose angles are from the zenith). F above the horizon is sky; the rest, down
to the facet's own plane, is terrain.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from schemas.errors import GeometryError
from stages.physics.horizon import horizon


def sky_view(
    elevation: ArrayLike, gsd: float, azimuths: int = 32, body_radius: float | None = None
) -> NDArray[np.float32]:
    """Share of a diffuse sky's light that reaches every facet, 0..1; 1 on a plain.

    elevation : (H, W), m, NaN = nothing there; gsd : m; azimuths : directions, evenly spaced, that horizons are taken in
    returns (H, W) float32; NaN where the elevation or a slope is. Beyond the grid the ground is taken as level.
    """
    if azimuths < 4:
        raise GeometryError(f"azimuths: expected at least 4, found {azimuths}.")
    grid = np.ascontiguousarray(elevation, dtype=np.float32)
    total = np.zeros_like(grid)
    for k in range(azimuths):
        azimuth = 2 * math.pi * k / azimuths
        _add_sky(grid, horizon(grid, gsd, azimuth, body_radius), gsd, math.sin(azimuth), math.cos(azimuth), total)
    total /= azimuths
    return total


@numba.njit(inline="always")
def _slope(z, r, c, gsd):
    """(dz/deast, dz/dnorth) by central differences, one-sided at the edges."""
    left, right = max(c - 1, 0), min(c + 1, z.shape[1] - 1)
    top, bottom = max(r - 1, 0), min(r + 1, z.shape[0] - 1)
    east = (z[r, right] - z[r, left]) / (gsd * (right - left)) if right > left else 0.0 * z[r, c]
    north = (z[top, c] - z[bottom, c]) / (gsd * (bottom - top)) if bottom > top else 0.0 * z[r, c]
    return east, north


@numba.njit(inline="always")
def _share(nz, nh, a):
    """F(a), of a facet with these components of its normal; see the module's docstring."""
    return nz * math.cos(a) ** 2 + nh * (0.5 * math.pi - a - math.sin(a) * math.cos(a))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _add_sky(z, angle, gsd, east, north, total):
    for r in numba.prange(z.shape[0]):
        for c in range(z.shape[1]):
            slope_east, slope_north = _slope(z, r, c, gsd)
            nz = 1 / math.sqrt(1 + slope_east**2 + slope_north**2)
            nh = -(slope_east * east + slope_north * north) * nz
            a = angle[r, c]
            if a < -1.57:
                a = 0.0
            total[r, c] += _share(nz, nh, max(a, math.atan2(-nh, nz)))


def terrain_light(
    elevation: ArrayLike, radiance_factor: ArrayLike, gsd: float, azimuths: int = 16, reach: float | None = None
) -> NDArray[np.float32]:
    """Light that every facet receives from the terrain it sees, taken as diffuse: one bounce.

    elevation, radiance_factor : (H, W), m and I/F of the lit scene; gsd : m
    azimuths : directions looked in; reach : m, how far (None: as far as the grid goes)
    returns (H, W) float32, irradiance in units of the Sun's: times a Lambert albedo it is the I/F to add. Repeated with
    the sum it gives the next bounce.
    """
    z, bright = (np.ascontiguousarray(v, dtype=np.float32) for v in (elevation, radiance_factor))
    if z.ndim != 2 or z.shape != bright.shape:
        raise GeometryError(
            f"radiance_factor: expected the elevation's shape (rows, columns), found {bright.shape} for {z.shape}."
        )
    light = np.zeros_like(z)
    _gather(z, bright, gsd, *_directions(azimuths), _distances(z.shape, gsd, reach), light)
    return light


class TerrainLight(torch.autograd.Function):
    """:func:`terrain_light` with the gradient to the radiance factor (its transpose); none to the elevation."""

    @staticmethod
    def forward(ctx, elevation: Tensor, radiance_factor: Tensor, gsd: float, azimuths: int = 16) -> Tensor:  # type: ignore[override]
        ctx.elevation, ctx.gsd, ctx.azimuths = elevation.detach().float().contiguous().numpy(), gsd, azimuths
        light = terrain_light(ctx.elevation, radiance_factor.detach().numpy(), gsd, azimuths)
        return torch.from_numpy(light).to(radiance_factor.dtype)

    @staticmethod
    def backward(ctx, gradient: Tensor):  # type: ignore[override]
        z = ctx.elevation
        back = np.zeros(z.shape, dtype=np.float64)
        upstream = gradient.detach().contiguous().numpy().astype(np.float64)
        _scatter(z, upstream, ctx.gsd, *_directions(ctx.azimuths), _distances(z.shape, ctx.gsd, None), back)
        return None, torch.from_numpy(back).to(gradient.dtype), None, None


def _directions(azimuths: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if azimuths < 4:
        raise GeometryError(f"azimuths: expected at least 4, found {azimuths}.")
    angle = 2 * math.pi * (np.arange(azimuths) + 0.5) / azimuths
    return np.sin(angle), np.cos(angle)


def _distances(shape: tuple[int, ...], gsd: float, reach: float | None) -> NDArray[np.float64]:
    """px: every pixel at first, then in steps of 1/32 of the distance."""
    limit = math.hypot(*shape) if reach is None else max(reach / gsd, 1.0)
    found = [1.0]
    while found[-1] < limit:
        found.append(found[-1] + max(1.0, found[-1] / 32))
    return np.array(found)


@numba.njit(inline="always")
def _corner(y, x, shape):
    """Pixel and fractions of a bilinear sample; the pixel is -1 outside the grid."""
    if not (0 <= y <= shape[0] - 1 and 0 <= x <= shape[1] - 1):
        return -1, -1, 0.0, 0.0
    r, c = min(int(y), max(shape[0] - 2, 0)), min(int(x), max(shape[1] - 2, 0))
    return r, c, y - r, x - c


@numba.njit(inline="always")
def _mix(v, r, c, fy, fx):
    below, beside = min(r + 1, v.shape[0] - 1), min(c + 1, v.shape[1] - 1)
    return (1 - fy) * ((1 - fx) * v[r, c] + fx * v[r, beside]) + fy * ((1 - fx) * v[below, c] + fx * v[below, beside])


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _gather(z, bright, gsd, east, north, distances, light):
    for r in numba.prange(z.shape[0]):
        for c in range(z.shape[1]):
            slope_east, slope_north = _slope(z, r, c, gsd)
            nz = 1 / math.sqrt(1 + slope_east**2 + slope_north**2)
            total = 0.0 * nz
            for k in range(east.size):
                nh = -(slope_east * east[k] + slope_north * north[k]) * nz
                highest = math.atan2(-nh, nz)
                seen = _share(nz, nh, highest)
                for d in distances:
                    row, column, fy, fx = _corner(r - d * north[k], c + d * east[k], z.shape)
                    if row < 0:
                        break
                    angle = math.atan((_mix(z, row, column, fy, fx) - z[r, c]) / (d * gsd))
                    if angle > highest:
                        share = _share(nz, nh, angle)
                        total += (seen - share) * _mix(bright, row, column, fy, fx)
                        highest, seen = angle, share
            light[r, c] = total / east.size


@numba.njit(cache=True, error_model="numpy")
def _scatter(z, upstream, gsd, east, north, distances, back):
    """The transpose of ``_gather``, by one thread: many facets send to the same pixel."""
    for r in range(z.shape[0]):
        for c in range(z.shape[1]):
            slope_east, slope_north = _slope(z, r, c, gsd)
            nz = 1 / math.sqrt(1 + slope_east**2 + slope_north**2)
            for k in range(east.size):
                nh = -(slope_east * east[k] + slope_north * north[k]) * nz
                highest = math.atan2(-nh, nz)
                seen = _share(nz, nh, highest)
                for d in distances:
                    row, column, fy, fx = _corner(r - d * north[k], c + d * east[k], z.shape)
                    if row < 0:
                        break
                    angle = math.atan((_mix(z, row, column, fy, fx) - z[r, c]) / (d * gsd))
                    if angle > highest:
                        share = _share(nz, nh, angle)
                        g = (seen - share) * upstream[r, c] / east.size
                        below, beside = min(row + 1, z.shape[0] - 1), min(column + 1, z.shape[1] - 1)
                        back[row, column] += g * (1 - fy) * (1 - fx)
                        back[row, beside] += g * (1 - fy) * fx
                        back[below, column] += g * fy * (1 - fx)
                        back[below, beside] += g * fy * fx
                        highest, seen = angle, share
