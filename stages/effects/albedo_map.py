"""A broad pattern of albedo that terrain does not tell."""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects.base import Effect, register
from stages.effects.fields import cosine_field
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

ORDERS = tuple((m, n) for m in range(4) for n in range(4) if 0 < m + n <= 4)


@register
class AlbedoMap(Effect):
    name = "albedo_map"
    slot = "reflectance"
    channel = "albedo"
    linear = True
    scope = "site"
    table = ("site_albedo", "term")
    title = "broad albedo pattern (rays, mare borders)"
    mechanism = (
        "Crater rays, swirls and mare borders change albedo over tens of pixels without a trace in the terrain: a low-order cosine "
        "field per site. Reported only where it stands out above the red spectrum of ordinary texture."
    )
    reference = "Hawke et al. (2004), Icarus 170, 1 (lunar rays)"
    confused_with = ("elevation_albedo", "slope_albedo")
    separate = "neighbouring sites: the pattern goes on across their borders, whatever the terrain"
    parameters = (Parameter("per_std", "1", 0.0, 1.0, 0.0, "rms of the field, relative to albedo"),)
    coordinates = tuple(Parameter(f"c{m}{n}", "1", -0.5, 0.5, 0.0, f"cosine {m} down, {n} across") for m, n in ORDERS)
    strong: ClassVar = {p.name: 0.05 for p in coordinates}
    tolerance: ClassVar = {"per_std": 0.03}

    def apply(self, state: State) -> None:
        height, width = state.elevation.shape[-2:]
        factor = torch.ones(height, width)
        for m, n in ORDERS:
            factor = factor + self.value(f"c{m}{n}", state) * cosine_field((m, n), height, width)
        state.reflectance = state.reflectance * factor
