"""A film or a scanner changes its response over a frame."""

from __future__ import annotations

import math
from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

TERMS = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2))  # cosines down and across a crop


@register
class FrameField(Effect):
    name = "frame_field"
    slot = "sensor"
    scope = "image"
    table = ("frame_field", "field_term")
    linear = True
    title = "response that varies over a frame"
    mechanism = (
        "Film is developed unevenly, lenses darken their corners and scanners drift: within a frame the response changes smoothly, another "
        "way in every frame. Low cosines over a crop, for images in dn, whose gain and offset are free anyway."
    )
    reference = "Lawrence et al. (2015), 46th LPSC, 2694 (scanned film of the Apollo metric camera)"
    confused_with = ("column_pattern", "albedo_map")
    separate = "crops of the same frame from elsewhere in it"
    parameters = (Parameter("rms", "1", 0.0, 1.0, 0.0, "rms of the response about its mean in a crop"),)
    coordinates = tuple(Parameter(f"f{m}{n}", "1", -0.5, 0.5, 0.0, f"cosine {m} down, {n} across") for m, n in TERMS)
    strong: ClassVar = {p.name: 0.02 for p in coordinates}
    tolerance: ClassVar = {"rms": 0.01}

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return survey.units == "dn"

    def apply(self, state: State) -> None:
        height, width = state.image.shape[-2:]
        y = (torch.arange(height, dtype=state.image.dtype) + 0.5) / height
        x = (torch.arange(width, dtype=state.image.dtype) + 0.5) / width
        factor = torch.ones_like(state.image)
        for m, n in TERMS:
            wave = torch.cos(math.pi * m * y)[:, None] * torch.cos(math.pi * n * x)
            factor = factor + self.value(f"f{m}{n}", state) * wave
        state.image = state.image * factor
