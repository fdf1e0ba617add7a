"""Albedo that follows the slope of the terrain."""

from __future__ import annotations

from typing import ClassVar

from stages.effects import fields
from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class SlopeAlbedo(Effect):
    name = "slope_albedo"
    slot = "reflectance"
    linear = True
    title = "albedo that follows slope"
    mechanism = (
        "Mass wasting on steep slopes uncovers fresh, bright material. Standardised over the data set: the same slope means the "
        "same albedo everywhere."
    )
    reference = "Robinson et al. (2015), Icarus 252, 229; Senthil Kumar et al. (2016), JGR 121, 147"
    confused_with = ("macroscopic_roughness", "limb_darkening")
    separate = "images of the same ground under at least four Sun azimuths, which tell albedo from shading"
    parameters = (
        Parameter("per_std", "1", -0.5, 0.5, 0.0, "relative change of albedo per standard deviation of slope"),
    )
    strong: ClassVar = {"per_std": 0.1}
    tolerance: ClassVar = {"per_std": 0.01}

    def apply(self, state: State) -> None:
        mean, std = self.survey.slope
        field = (fields.slope(state.observation.elevation, state.observation.gsd) - mean) / std
        state.reflectance = state.reflectance * (1 + self.value("per_std", state) * field)
