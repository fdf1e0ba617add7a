"""The Sun stands elsewhere in azimuth than the metadata say."""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class SunAzimuth(Effect):
    name = "sun_azimuth"
    slot = "illumination"
    title = "azimuth of the Sun"
    mechanism = (
        "A wrong time, or north of the map taken for north of the crop, turns the Sun about the vertical in every image alike: "
        "slopes across the Sun's direction brighten on one side and darken on the other. Clockwise is positive."
    )
    reference = (
        "Acton (1996), Planet. Space Sci. 44, 65 (ephemerides); Archinal et al. (2018), CMDA 130, 22 (body frames)"
    )
    confused_with = ("misregistration", "azimuthal_anisotropy")
    separate = "an image of the same ground with the Sun on another side"
    parameters = (Parameter("error_deg", "degree", -45.0, 45.0, 0.0, "truth minus given, the same for all images"),)
    strong: ClassVar = {"error_deg": 0.5}
    tried: ClassVar = {"error_deg": 0.2}
    # a DEM that is tilted by a quarter of a degree, as long waves of its errors do, seems to turn a Sun 30 deg high by so much
    tolerance: ClassVar = {"error_deg": 0.5}

    def apply(self, state: State) -> None:
        east, north, up = state.sun_direction.to(state.elevation.dtype).unbind(-1)
        angle = torch.deg2rad(self.value("error_deg", state))
        cosine, sine = torch.cos(angle), torch.sin(angle)
        state.sun_direction = torch.stack([east * cosine + north * sine, north * cosine - east * sine, up], -1)
