"""Albedo that follows a field of the terrain: slope, height or curvature."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from stages.effects import fields
from stages.effects.base import Effect, register
from stages.physics.formation.chain import Observation, State
from stages.physics.photometry import Parameter


class TerrainAlbedo(Effect):
    """Base: albedo changes in proportion to a field of the terrain, standardised over the data set."""

    slot = "reflectance"
    linear = True
    separate = "images of the same ground under at least four Sun azimuths, which tell albedo from shading"
    strong: ClassVar = {"per_std": 0.1}
    tolerance: ClassVar = {"per_std": 0.01}

    @abstractmethod
    def field(self, observation: Observation) -> Tensor:
        """(B, H, W), of mean 0 and standard deviation 1 over the data set."""

    def apply(self, state: State) -> None:
        field = self.field(state.observation)
        state.reflectance = state.reflectance * (1 + self.value("per_std", state) * field)


def _per_deviation(of: str) -> tuple[Parameter, ...]:
    return (Parameter("per_std", "1", -0.5, 0.5, 0.0, f"relative change of albedo per standard deviation of {of}"),)


@register
class SlopeAlbedo(TerrainAlbedo):
    name = "slope_albedo"
    title = "albedo that follows slope"
    mechanism = (
        "Mass wasting on steep slopes uncovers fresh, bright material. Standardised over the data set: the same slope means the "
        "same albedo everywhere."
    )
    reference = "Robinson et al. (2015), Icarus 252, 229; Senthil Kumar et al. (2016), JGR 121, 147"
    confused_with = ("macroscopic_roughness", "limb_darkening")
    parameters = _per_deviation("slope")

    def field(self, observation: Observation) -> Tensor:
        mean, std = self.survey.slope
        return (fields.slope(observation.elevation, observation.gsd) - mean) / std


@register
class ElevationAlbedo(TerrainAlbedo):
    name = "elevation_albedo"
    title = "albedo that follows height"
    mechanism = (
        "Lava floods low ground and is darker than the highlands; crater rays and dust settle by height. Standardised over the "
        "data set; waves of the DEM shorter than 7 px do not count."
    )
    reference = "Lucey et al. (1998), JGR 103, 3679 (lunar albedo and composition)"
    confused_with = ("albedo_map",)
    parameters = _per_deviation("height")

    def field(self, observation: Observation) -> Tensor:
        mean, std = self.survey.elevation
        return fields.broad((observation.elevation - mean) / std)


@register
class CurvatureAlbedo(TerrainAlbedo):
    name = "curvature_albedo"
    title = "albedo that follows curvature"
    mechanism = (
        "Ridges lose soil and hollows gather it: maturity, grain size and rock abundance follow the Laplacian of the height. "
        "Standardised over the data set, after a blur of 2 px."
    )
    reference = "Fassett & Thomson (2014), JGR 119, 2255 (diffusion of lunar soil)"
    confused_with = ("dem_smoothing", "interreflection")
    parameters = _per_deviation("curvature")

    def field(self, observation: Observation) -> Tensor:
        mean, std = self.survey.curvature
        return (fields.curvature(observation.elevation, observation.gsd) - mean) / std
