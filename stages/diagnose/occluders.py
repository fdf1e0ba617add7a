"""How far away stands what casts the shadow: far shadows tell of the Sun's disc, near ones of the DEM's errors."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from stages.physics.formation import Observation

EVERY = 12  # steps grow by this fraction of the distance: further away terrain rises in angle more slowly
BEYOND = math.radians(0.25)  # by so much the known horizon must exceed the crop's own to be terrain outside the crop


def occluder_distance(observation: Observation) -> Tensor:
    """Distance in px from every pixel to the terrain that stands highest towards the Sun, (B, H, W) float32.

    Searched within the crop; where the known horizon (``sun_horizon``) is higher than the crop's own, half a crop is
    taken. An error of the DEM's heights moves a shadow's edge by an angle that falls with this distance.
    """
    elevation, sun = observation.elevation, observation.sun_direction
    count, rows, columns = elevation.shape
    row, column = torch.arange(rows)[:, None], torch.arange(columns)
    out = torch.ones_like(elevation)
    for k in range(count):
        height, azimuth = elevation[k], math.atan2(float(sun[k, 0]), float(sun[k, 1]))
        steepest, where = torch.full_like(height, -math.inf), torch.ones_like(height)
        step = 1.0
        while step < math.hypot(rows, columns):
            up, right = round(step * math.cos(azimuth)), round(step * math.sin(azimuth))
            distance = math.hypot(up, right)
            there_r, there_c = row - up, column + right
            known = (there_r >= 0) & (there_r < rows) & (there_c >= 0) & (there_c < columns)
            there = height[there_r.clamp(0, rows - 1), there_c.clamp(0, columns - 1)]
            tangent = torch.where(known, (there - height) / (distance * observation.gsd), -math.inf)
            higher = tangent > steepest
            steepest = torch.where(higher, tangent, steepest)
            where = torch.where(higher, distance, where)
            step += max(1.0, step / EVERY)
        if observation.sun_horizon is not None:
            outside = observation.sun_horizon[k] > torch.atan(steepest) + BEYOND
            where = torch.where(outside, max(rows, columns) / 2, where)
        out[k] = where
    return out
