"""The Sun's disc is not as wide as assumed."""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation import State
from stages.physics.photometry import Parameter


@register
class Penumbra(Effect):
    name = "penumbra"
    slot = "illumination"
    channel = "edge"
    title = "width of the penumbra"
    mechanism = (
        "The Sun's disc makes shadow edges soft. A point source, a wrong distance of the Sun, or roughness of the horizon below "
        "the DEM's resolution makes real shadow edges wider or narrower than a disc of 0.2666 deg gives."
    )
    reference = "Hestroffer & Magnan (1998), A&A 333, 338 (solar limb); disc of 0.2666 deg at 1 au"
    confused_with = ("sun_elevation", "distant_shadow")
    separate = "an image with the Sun low enough to cast long shadows"
    parameters = (Parameter("radius_deg", "degree", 0.02, 3.0, 0.2666, "effective angular radius of the Sun"),)
    strong: ClassVar = {"radius_deg": 0.7}

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"radius_deg": r},)) for r in (0.45, 0.8, 1.2, 1.8, 2.5, 3.5)]

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return "sun_horizon" in has

    def apply(self, state: State) -> None:
        state.sun_radius = torch.deg2rad(self.value("radius_deg", state)).clamp(min=1e-4)
