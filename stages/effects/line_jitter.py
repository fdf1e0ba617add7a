"""The platform trembled while the lines were read."""

from __future__ import annotations

import math
from typing import ClassVar

import torch

from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

ORDERS = (1, 2, 3)


@register
class LineJitter(Effect):
    name = "line_jitter"
    slot = "geometry"
    scope = "image"
    table = ("line_jitter_px", "mode")
    displaces = True
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
        height = state.elevation.shape[-2]
        u = (torch.arange(height, dtype=state.elevation.dtype) + 0.5) / height
        none = torch.zeros(())
        east, south = state.displacement or (none, none)
        for k in ORDERS:
            wave = math.sqrt(2) * torch.cos(math.pi * k * u)[:, None]
            east = east + self.value(f"east{k}_px", state) * wave
            south = south + self.value(f"south{k}_px", state) * wave
        state.displacement = (east, south)
