"""Reflectance depends on where the light comes from."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

LOWEST = 0.1  # sine of the Sun's elevation: lower, relief below a pixel lies in its own shadow


def sun_cotangent(sun: Tensor) -> Tensor:
    """(n,) of the Sun's elevation, no lower than ``LOWEST``; sun : (n, 3) unit vectors, east north up"""
    level = torch.hypot(sun[:, 0], sun[:, 1]).clamp(min=1e-6)
    return level / sun[:, 2].clamp(min=LOWEST)


@register
class AzimuthalAnisotropy(Effect):
    name = "azimuthal_anisotropy"
    slot = "reflectance"
    title = "dependence on the Sun's azimuth"
    mechanism = (
        "Unresolved ripples, ejecta lineations or cliffs of one orientation reflect more when lit from one side: reflectance is "
        "multiplied by 1 + (east sin(azimuth) + north cos(azimuth)) (cot(elevation) / its mean)^shading of the Sun: 0 for what is painted "
        "on, 1 for relief below a pixel, which shades the more the lower the Sun."
    )
    reference = "Shkuratov et al. (2011), Planet. Space Sci. 59, 1326 (photometric anisotropy of the lunar surface)"
    confused_with = ("sun_azimuth", "image_gain")
    separate = "an image of the same ground with the Sun on the opposite side"
    parameters = (
        Parameter("east", "1", -0.3, 0.3, 0.0, "relative change when lit from the east at the mean elevation"),
        Parameter("north", "1", -0.3, 0.3, 0.0, "relative change when lit from the north at the mean elevation"),
    )
    coordinates = (*parameters, Parameter("shading", "1", 0.0, 1.5, 0.0, "how it grows as the Sun gets lower"))
    strong: ClassVar = {"east": 0.05, "north": 0.05}
    shaped = ("shading",)

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        columns = ({"east": 0.05}, {"north": 0.05})
        return [Trial(columns, {"shading": shading}) for shading in (0.0, 1.0)]

    def apply(self, state: State) -> None:
        sun = state.sun_direction.to(state.elevation.dtype)
        level = torch.hypot(sun[:, 0], sun[:, 1]).clamp(min=1e-6)
        east, north = (sun[:, 0] / level)[:, None, None], (sun[:, 1] / level)[:, None, None]
        across = self.value("east", state) * east + self.value("north", state) * north
        lowness = (sun_cotangent(sun) / self.survey.sun_cotangent)[:, None, None]
        state.reflectance = state.reflectance * (1 + across * lowness ** self.value("shading", state))
