"""Relief leans away from the camera, because the image was not orthorectified or was over another DEM."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from stages.effects.base import Effect, Survey, register
from stages.physics.formation import geometry
from stages.physics.formation.chain import Observation, State
from stages.physics.photometry import Parameter

ORDINARY = 0.1  # px: what errors of the heights leave in any orthorectified image


@register
class ReliefDisplacement(Effect):
    name = "relief_displacement"
    slot = "geometry"
    scope = "image"
    judged_apart = True
    leans = True
    displaces = True
    title = "relief displacement (missing or wrong orthorectification)"
    mechanism = (
        "An oblique ray that is laid on a smooth sphere instead of on the terrain shows a point of height h away from its place, "
        "by h tan(emission) along the azimuth of the view. Share 1 is an image that was not orthorectified at all; heights count "
        "from the mean of the data, and what a smooth field per frame can do as well is left to that."
    )
    reference = "Mikhail, Bethel & McGlone (2001), Introduction to Modern Photogrammetry, ch. 3 (relief displacement)"
    confused_with = ("misregistration", "dem_scale")
    separate = "an image of the same ground from another side"
    parameters = (
        Parameter("share", "1", -3.0, 3.0, 0.0, "share of h tan(emission) that was not taken out"),
        Parameter("rms_px", "px", 0.0, 50.0, 0.0, "rms displacement over the data"),
    )
    coordinates = (parameters[0],)
    strong: ClassVar = {"share": 0.5}
    tolerance: ClassVar = {"rms_px": ORDINARY}

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return survey.lean_px > 0.05

    def apply(self, state: State) -> None:
        east, south = lean(state.observation, self.survey.elevation[0])
        share = self.value("share", state)
        before = state.displacement or (0.0, 0.0)
        state.displacement = (before[0] + share * east, before[1] + share * south)


def lean(observation: Observation, level: float) -> tuple[Tensor, Tensor]:
    """How far east and south, px, the ground lies that a pixel of an image laid on height ``level`` shows; (n, H, W) each."""
    view = geometry.view_vectors(observation.elevation, observation.camera_position, observation.gsd)
    up = view[2].clamp(min=0.05)
    height = (observation.elevation - level) / observation.gsd
    return height * view[0] / up, -height * view[1] / up
