"""The terrain horizon as a torch function, for gradients to elevation and azimuth through penumbrae (small crops)."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample


def differentiable_horizon(elevation: Tensor, gsd: float, azimuth: Tensor) -> Tensor:
    """Elevation angle of the highest terrain of the crop in one azimuth per crop.

    elevation : (B, H, W), m, without NaN; azimuth : (B,), rad, clockwise from north
    returns (B, H, W), rad, -pi/2 where nothing lies in that azimuth

    Every pixel looks along its own ray, where it crosses rows (or columns, whichever it crosses more steeply): work and
    memory grow with H W max(H, W). ``horizon.horizon`` is the fast one without gradients. The gradient is that of the
    point that stands highest now: it is right wherever the choice of that point is not a tie.
    """
    height, width = elevation.shape[-2:]
    azimuth = azimuth.to(elevation.dtype)
    east, north = torch.sin(azimuth), torch.cos(azimuth)
    stride = 1 / torch.maximum(east.abs(), north.abs())  # px along the ray from one crossing to the next
    row = torch.arange(height, dtype=elevation.dtype, device=elevation.device)[:, None]
    col = torch.arange(width, dtype=elevation.dtype, device=elevation.device)
    best = torch.full_like(elevation, -math.inf)
    for k in range(1, max(height, width)):
        distance = k * stride[:, None, None]
        y = row - distance * north[:, None, None]
        x = col + distance * east[:, None, None]
        # a crossing lies on a row or column up to rounding: half a thousandth of a pixel keeps the border's own
        inside = (y > -5e-4) & (x > -5e-4) & (y < height - 1 + 5e-4) & (x < width - 1 + 5e-4)
        if not inside.any():
            break
        scaled = torch.broadcast_tensors(2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1)
        places = torch.stack(scaled, -1)
        seen = grid_sample(elevation[:, None], places, padding_mode="border", align_corners=True)[:, 0]
        slope = (seen - elevation) / (distance * gsd)
        best = torch.where(inside & (slope > best), slope, best)
    nothing = torch.isinf(best)
    angle = torch.atan(torch.where(nothing, torch.zeros_like(best), best))
    return torch.where(nothing, torch.full_like(best, -math.pi / 2), angle)
