"""The DEM's heights are wrong by a factor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

ORDINARY = 0.02  # what a DEM that is too smooth does to the lengths of shadows


@register
class DemScale(Effect):
    name = "dem_scale"
    slot = "geometry"
    title = "vertical scale of the DEM"
    mechanism = (
        "A wrong base-to-height ratio in stereo, or shape from shading with a wrong albedo, scales all heights: every slope, "
        "every shaded contrast and every shadow length is off by the same factor."
    )
    reference = "Kirk et al. (2003), ISPRS WG IV/9 (vertical precision of photogrammetric DEMs)"
    confused_with = ("dem_smoothing", "sun_elevation")
    separate = "an image with the Sun much lower, where shadow lengths give heights"
    parameters = (Parameter("relative", "1", -0.5, 1.0, 0.0, "relative error of heights, truth minus given"),)
    strong: ClassVar = {"relative": 0.1}
    tried: ClassVar = {"relative": 0.05}
    tolerance: ClassVar = {"relative": 0.02}
    # rms of what was found by shading on 53 files of two other simulators that have no such error, by formal errors of 0.01
    law_error: ClassVar = {"relative": 0.075}
    shadow_error = ORDINARY

    @classmethod
    def shadow_trials(cls, survey: Survey) -> list[Trial]:
        errors = (-0.3, -0.2, -0.14, -0.1, -0.07, -0.04, -ORDINARY, 0.0, ORDINARY, 0.04, 0.07, 0.1, 0.14, 0.2, 0.3, 0.4)
        return [Trial(({"relative": e},)) for e in errors]

    @classmethod
    def shadows_ordinarily(cls, values: Mapping[str, Any]) -> bool:
        return abs(float(values["relative"])) <= ORDINARY

    def apply(self, state: State) -> None:
        factor = 1 + self.value("relative", state)
        mean = state.elevation.mean(dim=(-2, -1), keepdim=True)
        state.elevation = mean + factor * (state.elevation - mean)
        if state.sun_horizon is not None:
            state.sun_horizon = torch.atan(factor * torch.tan(state.sun_horizon.clamp(-1.5, 1.5)))
