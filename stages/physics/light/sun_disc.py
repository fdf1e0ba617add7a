"""Visible share of the Sun's disc above a straight horizon, which gives cast shadows their penumbra."""

from __future__ import annotations

import math

import torch
from torch import Tensor

SUN_RADIUS = math.radians(0.2666)  # mean angular radius of the Sun at 1 au
DARKENING = 0.6  # u of the limb darkening I = 1 - u (1 - mu) in visible light (Cox 2000)
DARKENED = DARKENING * 2 / 3 / (1 - DARKENING / 3)  # flux of the mu-term over the whole disc's


def sun_visibility(sun_elevation: Tensor, horizon: Tensor, radius: float | Tensor = SUN_RADIUS) -> Tensor:
    """Share of the Sun's light above a straight horizon, 0..1.

    For a disc of uniform brightness the share is 1/2 - (t sqrt(1 - t^2) + asin(t)) / pi, with the horizon t radii above
    the centre. Linear limb darkening turns its slices from 2 sqrt(1 - t^2) into 2 (1 - u) sqrt(1 - t^2) + u pi/2 (1 - t^2).

    sun_elevation, horizon : rad, broadcastable
    """
    t = ((horizon - sun_elevation) / radius).clamp(-1 + 1e-6, 1 - 1e-6)
    uniform = 0.5 - (t * torch.sqrt(1 - t * t) + torch.asin(t)) / math.pi
    darkened = 0.5 - 0.75 * (t - t**3 / 3)  # the share for slices of weight (1 - t^2), by the same integral
    return (1 - DARKENED) * uniform + DARKENED * darkened


def visibility_slope(t: Tensor) -> Tensor:
    """Change of that share per radius by which the horizon rises: less the disc's flux along the horizon.

    t : (N,) or any shape, how far the horizon stands above the Sun's centre, in radii; returns likewise
    """
    inside = (1 - t * t).clamp(min=0)
    return -(1 - DARKENED) * 2 / math.pi * inside.sqrt() - DARKENED * 0.75 * inside
