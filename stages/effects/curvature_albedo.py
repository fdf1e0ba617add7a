"""Albedo that follows the curvature of the terrain."""

from __future__ import annotations

from typing import ClassVar

from stages.effects import fields
from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class CurvatureAlbedo(Effect):
    name = "curvature_albedo"
    slot = "reflectance"
    linear = True
    title = "albedo that follows curvature"
    mechanism = (
        "Ridges lose soil and hollows gather it: maturity, grain size and rock abundance follow the Laplacian of the height. "
        "Standardised over the data set, after a blur of 2 px."
    )
    reference = "Fassett & Thomson (2014), JGR 119, 2255 (diffusion of lunar soil)"
    confused_with = ("dem_smoothing", "interreflection")
    separate = "images of the same ground under at least four Sun azimuths, which tell albedo from shading"
    parameters = (
        Parameter("per_std", "1", -0.5, 0.5, 0.0, "relative change of albedo per standard deviation of curvature"),
    )
    strong: ClassVar = {"per_std": 0.1}
    tolerance: ClassVar = {"per_std": 0.01}

    def apply(self, state: State) -> None:
        mean, std = self.survey.curvature
        field = (fields.curvature(state.observation.elevation, state.observation.gsd) - mean) / std
        state.reflectance = state.reflectance * (1 + self.value("per_std", state) * field)
