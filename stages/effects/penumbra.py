"""The Sun's disc is not as wide as assumed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

# Relief below the DEM's resolution blurs shadows cast from afar like a disc of this radius, deg, ...
RELIEF = 0.75
RELIEF_SPREAD = 0.25  # ... with this standard deviation, as a share, from one piece of ground to the next
BEYOND = 1.4  # times that: what some ground does alone, so that a wide Sun must do more


@register
class Penumbra(Effect):
    name = "penumbra"
    slot = "illumination"
    title = "width of the penumbra"
    mechanism = (
        "The Sun's disc makes shadow edges soft. A point source, a wrong distance of the Sun, or roughness of the horizon below "
        "the DEM's resolution makes real shadow edges wider or narrower than a disc of 0.2666 deg gives."
    )
    reference = "Hestroffer & Magnan (1998), A&A 333, 338 (solar limb); disc of 0.2666 deg at 1 au"
    confused_with = ("sun_elevation", "distant_shadow")
    separate = "an image with the Sun low enough to cast long shadows"
    parameters = (Parameter("radius_deg", "degree", 0.02, 3.0, 0.2666, "effective angular radius of the Sun"),)
    coordinates = (
        Parameter(
            "disc_deg2", "degree^2", 4e-4, 12.0, 0.2666**2, "square of the radius that shadows show: squares add"
        ),
        Parameter("relief_deg", "degree", 0.0, 30.0, 0.0, "disc that relief alone makes of the Sun: in disc_deg2"),
    )
    strong: ClassVar = {"disc_deg2": 4.0}

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        radii = (0.45, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0)
        return [Trial(({"disc_deg2": r * r},), {"relief_deg": RELIEF}) for r in radii]

    @classmethod
    def shadow_trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"disc_deg2": r * r},)) for r in (0.2666, 0.45, 0.6, 0.75, 0.9, 1.05, 1.3, 1.6, 2.0, 2.5, 3.0)]

    @classmethod
    def shadows_ordinarily(cls, values: Mapping[str, Any]) -> bool:
        return True  # errors of the DEM make edges as wide: what they do cannot be told from a wide Sun

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return "sun_horizon" in has

    @classmethod
    def report(cls, values: Mapping[str, float], errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """The Sun's radius, deg: what shadows show, without relief's share of it."""
        square, relief = values["disc_deg2"], values["relief_deg"]
        least = cls.null()["disc_deg2"] if relief else 0.0  # what relief blurs is a disc already
        sun = math.sqrt(max(square - relief**2, 0.0) + least)
        error = math.hypot(errors.get("disc_deg2", 0.0), 2 * relief**2 * RELIEF_SPREAD) / (2 * sun)
        return {"radius_deg": (sun, error)}

    def apply(self, state: State) -> None:
        state.sun_radius = torch.deg2rad(self.value("disc_deg2", state).clamp(min=1e-6).sqrt()).clamp(min=1e-4)
