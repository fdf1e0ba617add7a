"""Shifts that albedo makes: where ground is brighter the more it bends, an image looks as if it lay further along the Sun's azimuth.

Shading goes with the slope along the Sun's azimuth over the tangent of its elevation. A small shift along it adds the change of that slope,
which is a curvature; so albedo that goes with curvature passes for shifts that grow with that tangent, in every image along its own Sun.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.diagnose.model.sites import Site

FEWEST = 3  # frames: of fewer any shifts may lie so
EXPLAINED = 0.8  # of the squares of the shifts: chance leaves three frames so in one of a hundred cases, and more frames in fewer


def sunward(shifts: Tensor, sites: Sequence[Site]) -> bool:
    """Whether one number times the tangent of the Sun's elevation, along its azimuth, is nearly all of the shifts (frames, 2), east and south."""
    suns, count = torch.zeros(len(shifts), 3, dtype=torch.float64), torch.zeros(len(shifts))
    for site in sites:
        frames = torch.from_numpy(site.frames)
        suns.index_add_(0, frames, site.observation.sun_direction.double())
        count.index_add_(0, frames, torch.ones(len(frames)))
    used = (count > 0) & shifts.any(1)
    if int(used.sum()) < FEWEST:
        return False
    east, north, up = suns[used].unbind(1)
    level = torch.hypot(east, north).clamp(min=1e-9)
    along = torch.stack([east, -north], 1) * (up / level.square())[:, None]
    found = shifts[used].double()
    explained = (found * along).sum().square() / along.square().sum().clamp(min=1e-12)
    return bool(explained > EXPLAINED * found.square().sum())


__all__ = ["sunward"]
