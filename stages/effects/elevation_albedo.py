"""Albedo that follows the height of the terrain."""

from __future__ import annotations

from typing import ClassVar

from stages.effects import fields
from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class ElevationAlbedo(Effect):
    name = "elevation_albedo"
    slot = "reflectance"
    linear = True
    title = "albedo that follows height"
    mechanism = (
        "Lava floods low ground and is darker than the highlands; crater rays and dust settle by height. Standardised over the "
        "data set; waves of the DEM shorter than 7 px do not count."
    )
    reference = "Lucey et al. (1998), JGR 103, 3679 (lunar albedo and composition)"
    confused_with = ("albedo_map",)
    separate = "images of the same ground under at least four Sun azimuths, which tell albedo from shading"
    parameters = (
        Parameter("per_std", "1", -0.5, 0.5, 0.0, "relative change of albedo per standard deviation of height"),
    )
    strong: ClassVar = {"per_std": 0.1}
    tolerance: ClassVar = {"per_std": 0.01}

    def apply(self, state: State) -> None:
        mean, std = self.survey.elevation
        field = fields.broad((state.observation.elevation - mean) / std)
        state.reflectance = state.reflectance * (1 + self.value("per_std", state) * field)
