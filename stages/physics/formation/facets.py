"""Angles and sunlight of every facet of a batch of crops, in one pass over its elevations.

To rounding the same as ``geometry`` and ``light.sun_disc`` give, for training and prediction on the CPU, where only
coefficients have gradients. Each tensor operation there is a pass over memory; together they would cost more than a
reflectance model and its gradient.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit
from torch import Tensor

from stages.common.threads import share_out
from stages.physics.formation.geometry import Angles
from stages.physics.light.sun_disc import SUN_RADIUS, disc_share
from stages.physics.photometry import horizon_cosine

FLOOR = np.float32(horizon_cosine(torch.float32))
RADII_PER_RAD = np.float32(1 / SUN_RADIUS)


def angles_and_light(
    elevation: Tensor,
    sun_direction: Tensor,
    camera_position: Tensor,
    sun_horizon: Tensor | None,
    gsd: float,
    body_radius: float,
) -> tuple[Angles, Tensor] | None:
    """Angles, and the share of the Sun, 0..1, that lights a facet; 0 where Sun or camera are behind it.

    elevation : (B, H, W), m; sun_direction : (B, 3), unit, ENU; camera_position : (B, 3), m from the crop's centre;
    sun_horizon : (B, H, W), rad, or None
    returns None where the differentiable chain is needed: with gradients in these arguments, in float64, on a GPU
    """
    known = [t for t in (elevation, sun_direction, camera_position, sun_horizon) if t is not None]
    maps = [t for t in (elevation, sun_horizon) if t is not None]
    if any(t.requires_grad or t.device.type != "cpu" for t in known):
        return None
    if any(t.dtype != torch.float32 or t.shape != elevation.shape for t in maps) or min(elevation.shape[1:]) < 2:
        return None
    crops, height, width = elevation.shape
    places = torch.empty(crops, 8)  # of the Sun, its elevation, of the camera, and the crop's mean level
    places[:, :3], places[:, 3] = sun_direction, torch.asin(sun_direction[:, 2].clamp(-1, 1))
    places[:, 4:7], places[:, 7] = camera_position, elevation.mean(dim=(1, 2))
    z = elevation.contiguous()
    edge = z if sun_horizon is None else sun_horizon.contiguous()
    east = (np.arange(width) - (width - 1) / 2) * gsd
    north = ((height - 1) / 2 - np.arange(height)) * gsd
    axes = [v.astype(np.float32) for v in (east, north, east / body_radius, north / body_radius)]
    out = [torch.empty_like(z) for _ in range(4)]
    inputs = z.numpy(), edge.numpy(), sun_horizon is not None, places.numpy(), *axes, np.float32(1 / gsd)
    share_out(_angles_and_light, crops, *inputs, *(t.numpy() for t in out))
    *cosines, light = out
    return Angles(*cosines), light


@njit(nogil=True, cache=True, error_model="numpy")
def _angles_and_light(
    first, last, z, edge, shaded, places, east, north, bend_east, bend_north, per_pixel, mu0, mu, cos_phase, light
):
    height, width = z.shape[1:]
    one = np.float32(1)
    half = np.float32(0.5) * per_pixel
    slope = np.empty(width, np.float32)
    for n in range(first, last):
        sx, sy, sz, sun_elevation, cx, cy, cz, level = places[n]
        for r in range(height):
            row, above, below = z[n, r], z[n, max(r - 1, 0)], z[n, min(r + 1, height - 1)]
            ahead, behind, inner = row[2:], row[:-2], slope[1:-1]
            for j in range(inner.size):
                inner[j] = (ahead[j] - behind[j]) * half
            slope[0], slope[-1] = (row[1] - row[0]) * per_pixel, (row[-1] - row[-2]) * per_pixel
            step = half if 0 < r < height - 1 else per_pixel
            y, bend = cy - north[r], bend_north[r]
            out_mu0, out_mu, out_phase, out_light = mu0[n, r], mu[n, r], cos_phase[n, r], light[n, r]
            for j in range(width):
                p = slope[j] - bend_east[j]
                q = (above[j] - below[j]) * step - bend
                x, h = cx - east[j], cz - (row[j] - level)
                normal = one / np.sqrt(one + p * p + q * q)
                near = one / np.sqrt(x * x + y * y + h * h)
                out_mu0[j] = (sz - p * sx - q * sy) * normal
                out_mu[j] = (h - p * x - q * y) * near * normal
                out_phase[j] = (sx * x + sy * y + sz * h) * near
                out_light[j] = np.float32((out_mu0[j] > FLOOR) & (out_mu[j] > FLOOR))
            if shaded:
                _shade(out_light, edge[n, r], sun_elevation)


@njit(nogil=True, cache=True, error_model="numpy")
def _shade(light, edge, sun_elevation):
    """Take off the part of the Sun below the horizon, along a row of facets; few rows have pixels in penumbra."""
    one = np.float32(1)
    partly = 0
    for j in range(light.size):
        t = (edge[j] - sun_elevation) * RADII_PER_RAD
        light[j] = np.float32(0) if t >= one else light[j]
        partly += not abs(t) >= one  # also what is not a number
    for j in range(light.size if partly else 0):
        t = (edge[j] - sun_elevation) * RADII_PER_RAD
        if not abs(t) >= one:
            light[j] *= disc_share(t, math.sqrt(one - t * t), math.asin(t))
