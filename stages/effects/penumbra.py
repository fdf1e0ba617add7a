"""The Sun's disc is not as wide as assumed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

NARROW = 0.9  # deg: up to here errors of the DEM, where they grow with distance, widen edges as well


@register
class Penumbra(Effect):
    name = "penumbra"
    slot = "illumination"
    title = "width of the penumbra"
    mechanism = (
        "The Sun's disc makes shadow edges soft. A point source or a wrong distance of the Sun makes real shadow edges wider or narrower "
        "than a disc of 0.2666 deg gives, by the same angle however far away what casts them stands."
    )
    reference = "Hestroffer & Magnan (1998), A&A 333, 338 (solar limb); disc of 0.2666 deg at 1 au"
    confused_with = ("sun_elevation", "distant_shadow")
    separate = "an image with the Sun low enough to cast long shadows"
    parameters = (Parameter("radius_deg", "degree", 0.02, 4.0, 0.2666, "effective angular radius of the Sun"),)
    strong: ClassVar = {"radius_deg": 2.0}
    shadow_error = 0.1
    edges_tell = True  # light that a wide disc brings into deep shadow passes for any other light there

    @classmethod
    def shadow_trials(cls, survey: Survey) -> list[Trial]:
        radii = (0.2666, 0.4, 0.55, 0.7, NARROW, 1.05, 1.3, 1.6, 2.0, 2.5, 3.0, 3.5, 4.0)
        return [Trial(({"radius_deg": r},)) for r in radii]

    @classmethod
    def shadows_ordinarily(cls, values: Mapping[str, Any]) -> bool:
        return float(values["radius_deg"]) <= NARROW

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return "sun_horizon" in has

    def apply(self, state: State) -> None:
        state.sun_radius = torch.deg2rad(self.value("radius_deg", state)).clamp(min=1e-4)
