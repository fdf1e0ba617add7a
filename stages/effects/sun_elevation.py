"""The Sun stands elsewhere in elevation than the metadata say."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

HORIZON = 0.3  # deg: what errors of the DEM do to horizons, beyond the blur and lift that go with distance


@register
class SunElevation(Effect):
    name = "sun_elevation"
    slot = "illumination"
    of_law = True  # on lit ground it goes with incidence as the law does; shadows tell
    shadow_error = HORIZON / 2
    title = "elevation of the Sun"
    mechanism = (
        "A wrong time, a wrong latitude or a local frame that is not level raises or lowers the Sun in every image alike: "
        "all shading contrast and all shadow edges move together."
    )
    reference = (
        "Acton (1996), Planet. Space Sci. 44, 65 (ephemerides); Archinal et al. (2018), CMDA 130, 22 (body frames)"
    )
    confused_with = ("penumbra", "dem_scale", "nonlinearity")
    separate = "an image of the same ground with the Sun at least 20 deg higher or lower"
    parameters = (Parameter("error_deg", "degree", -10.0, 10.0, 0.0, "truth minus given, the same for all images"),)
    strong: ClassVar = {"error_deg": 0.5}
    tried: ClassVar = {"error_deg": 0.2}

    @classmethod
    def shadow_trials(cls, survey: Survey) -> list[Trial]:
        errors = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0)
        return [Trial(({"error_deg": e},)) for e in (*(-x for x in errors[:0:-1]), *errors)]

    @classmethod
    def shadows_ordinarily(cls, values: Mapping[str, Any]) -> bool:
        return abs(float(values["error_deg"])) <= HORIZON

    def apply(self, state: State) -> None:
        east, north, up = state.sun_direction.to(state.elevation.dtype).unbind(-1)
        angle = torch.deg2rad(self.value("error_deg", state))
        raised = (torch.asin(up.clamp(-1, 1)) + angle).clamp(max=math.pi / 2 - 1e-4)
        level = torch.sqrt(east * east + north * north).clamp(min=1e-9)
        across = torch.cos(raised) / level
        state.sun_direction = torch.stack([east * across, north * across, torch.sin(raised)], -1)
