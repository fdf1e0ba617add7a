"""The image is smeared along the detector's lines more than along its samples, or less."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Trial, register
from stages.effects.fields import kept_axes
from stages.effects.filters import directed
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class MotionBlur(Effect):
    name = "motion_blur"
    listed = False
    slot = "sensor"
    title = "blur in one direction of the detector, as motion makes it"
    mechanism = (
        "While light is collected the ground moves along the detector's lines (or, where a camera trembles, its samples). What is blurred more in one "
        "direction than in the other is told here, the rest is a blur of the optics: an even motion over m pixels has a variance of m^2 / 12, half of "
        "it either way. A line camera's own line leaves 1/24; less than 0.1 is not told, since oblique views leave as much."
    )
    reference = (
        "Boreman (2001), Modulation Transfer Function in Optical and Electro-Optical Systems, SPIE (image motion)"
    )
    confused_with = ("psf_blur", "dem_smoothing")
    separate = "an image turned against the others"
    parameters = (
        Parameter("sigma2_px2", "px2", -4.0, 4.0, 0.0, "variance added along lines and taken away along samples"),
    )
    strong: ClassVar = {"sigma2_px2": 0.5}
    tolerance: ClassVar = {"sigma2_px2": 0.1}

    @classmethod
    def ordinary(cls, trial: Trial) -> float:
        """Nothing beside which optics would be judged: what all data have of it is a part of theirs."""
        return 0.0

    def apply(self, state: State) -> None:
        samples, lines = (step.to(state.image) for step in kept_axes(state.observation, len(state.image)))
        variance = torch.as_tensor(self.values["sigma2_px2"], dtype=state.image.dtype)

        def gain(kx: Tensor, ky: Tensor) -> Tensor:
            along, across = (kx * s[:, 0, None, None] + ky * s[:, 1, None, None] for s in (lines, samples))
            return torch.exp(-0.5 * variance * (along.square() - across.square())).clamp(max=4.0)

        state.image = directed(state.image, gain)
