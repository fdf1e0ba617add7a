"""The Sun's disc is not as wide as assumed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation import State
from stages.physics.photometry import Parameter

# Relief below the DEM's resolution blurs far shadows like a disc of this radius, deg, and more on rugged ground:
# by so much per change of slope over a pixel (Laplacian of the heights after a 2 px blur, times the pixel).
RELIEF, PER_BEND = 0.9, 26.0
BEYOND = 2.25  # times that: what some ground does alone, so that a wide Sun must do more
RELIEF_SPREAD = 0.25  # standard deviation of that, as a share, from one piece of ground to the next


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
    coordinates = (
        *parameters,
        Parameter(
            "relief_deg", "degree", 0.0, 30.0, 0.0, "disc that relief alone makes of the Sun: in radius_deg as fitted"
        ),
    )
    strong: ClassVar = {"radius_deg": 2.0}

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        relief = max(RELIEF, PER_BEND * survey.curvature[1] * survey.gsd)
        return [Trial(({"radius_deg": r},), {"relief_deg": relief}) for r in (0.45, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0)]

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return "sun_horizon" in has

    @classmethod
    def report(cls, values: Mapping[str, float], errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """The Sun's radius, deg: variances of discs add, and relief has its share."""
        radius, relief, least = values["radius_deg"], values["relief_deg"], cls.null()["radius_deg"]
        if relief == 0:
            return {"radius_deg": (radius, errors.get("radius_deg", 0.0))}
        sun = math.sqrt(max(radius**2 - relief**2 + least**2, least**2))
        error = math.hypot(radius * errors.get("radius_deg", 0.0), relief**2 * RELIEF_SPREAD) / sun
        return {"radius_deg": (sun, error)}

    def apply(self, state: State) -> None:
        state.sun_radius = torch.deg2rad(self.value("radius_deg", state)).clamp(min=1e-4)
