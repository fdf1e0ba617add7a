"""How far away stands what casts the shadow: far shadows tell of the Sun's disc, near ones of the DEM's errors."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from stages.physics.formation.chain import Observation

STEP, UNTIL = 0.5, 12  # px: fine steps near by; further away than so many steps they grow with the distance
BEYOND = math.radians(0.25)  # by so much the known horizon must exceed the crop's own to be terrain outside the crop


def occluder_distance(observation: Observation) -> Tensor:
    """Distance in px from every pixel to the terrain that stands highest towards the Sun, (B, H, W) float32.

    Searched within the crop, with heights between its pixels: what stands one to three pixels away is easily missed, and
    its shadows are those that an error of the DEM's heights moves most, by an angle that falls with the distance. Where
    the known horizon (``sun_horizon``) is higher than the crop's own, the distance to the crop's border is taken.
    """
    elevation, sun = observation.elevation, observation.sun_direction
    out = torch.ones_like(elevation)
    for k, height in enumerate(elevation):
        azimuth = math.atan2(float(sun[k, 0]), float(sun[k, 1]))
        steepest, out[k], border = _highest(height, math.sin(azimuth), math.cos(azimuth))
        if observation.sun_horizon is not None:
            outside = observation.sun_horizon[k] > torch.atan(steepest / observation.gsd) + BEYOND
            out[k] = torch.where(outside, border, out[k])
    return out


def _highest(height: Tensor, east: float, north: float) -> tuple[Tensor, Tensor, Tensor]:
    """Steepest rise per px towards the Sun, how far away it is found, and how far away the grid ends, px, (H, W) each."""
    rows, columns = height.shape
    row, column = torch.arange(rows, dtype=torch.float32), torch.arange(columns, dtype=torch.float32)
    steepest, where = torch.full_like(height, -math.inf), torch.ones_like(height)
    step = 1.0
    while step < math.hypot(rows, columns):
        near_r, next_r, share_r, in_r = _between(row - step * north, rows)
        near_c, next_c, share_c, in_c = _between(column + step * east, columns)
        along = torch.lerp(height[near_r], height[next_r], share_r[:, None])
        there = torch.lerp(along[:, near_c], along[:, next_c], share_c)
        rise = torch.where(in_r[:, None] & in_c, (there - height) / step, -math.inf)
        higher = rise > steepest
        steepest = torch.where(higher, rise, steepest)
        where = torch.where(higher, step, where)
        step += max(STEP, step / UNTIL)
    to_r = (row if north > 0 else rows - 1 - row) / max(abs(north), 1e-6)
    to_c = (columns - 1 - column if east > 0 else column) / max(abs(east), 1e-6)
    return steepest, where, torch.minimum(to_r[:, None], to_c).clamp(min=1.0)


def _between(place: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The two neighbours of fractional places on a grid, the share of the second, and whether the grid has the place."""
    first = place.floor()
    near = first.long().clamp(0, count - 1)
    return near, (near + 1).clamp(max=count - 1), place - first, (place >= 0) & (place <= count - 1)


__all__ = ["occluder_distance"]
