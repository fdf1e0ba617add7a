"""The platform trembled while the lines were read."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

ORDERS = (1, 2, 3)


def crop_waves(height: int) -> Tensor:
    """(len(ORDERS), height): cosines over the lines, of mean square 1."""
    u = (torch.arange(height) + 0.5) / height
    return math.sqrt(2) * torch.cos(math.pi * torch.tensor(ORDERS)[:, None] * u)


@register
class LineJitter(Effect):
    name = "line_jitter"
    slot = "geometry"
    scope = "image"
    table = ("line_jitter_px", "mode")
    displaces = True
    judged_apart = True
    along_lines = True
    relative = True
    title = "lines shifted against each other"
    mechanism = (
        "A line-scan camera reads lines one after the other while the platform's pointing drifts and trembles: the lines "
        "of an image are shifted by a slowly varying amount, across and along the track."
    )
    reference = "Mattson et al. (2009), EPSC 2009-604 (jitter of HiRISE and LROC NAC)"
    confused_with = ("misregistration",)
    separate = "an image of the same ground taken with another camera or on another track"
    parameters = (Parameter("rms_px", "px", 0.0, 10.0, 0.0, "rms shift beyond a constant"),)
    coordinates = tuple(
        Parameter(f"{axis}{k}_px", "px", -5.0, 5.0, 0.0, f"amplitude of cosine {k} over the lines, {axis}")
        for axis in ("east", "south")
        for k in ORDERS
    )
    strong: ClassVar = {p.name: 0.5 for p in coordinates}
    tolerance: ClassVar = {"rms_px": 0.15}

    def apply(self, state: State) -> None:
        none = torch.zeros(())
        east, south = state.displacement or (none, none)
        waves = crop_waves(state.elevation.shape[-2]).to(state.elevation)[:, :, None]
        for k, wave in zip(ORDERS, waves, strict=True):
            east = east + self.value(f"east{k}_px", state) * wave
            south = south + self.value(f"south{k}_px", state) * wave
        state.displacement = (east, south)
