"""Bright pixels are cut off."""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class Saturation(Effect):
    name = "saturation"
    slot = "sensor"
    title = "saturation"
    mechanism = (
        "The full well or the converter's last step cuts the signal off: nothing brighter than a level is recorded."
    )
    reference = "Janesick (2001), Scientific Charge-Coupled Devices, SPIE (full well)"
    confused_with = ("nonlinearity",)
    separate = "an image of the same ground at a shorter exposure or a lower Sun"
    parameters = (Parameter("iof", "1", 1e-4, 10.0, 10.0, "level at which the signal is cut"),)
    strong: ClassVar = {"iof": 0.0}  # set by the trials: the data's own brightness decides

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"iof": q},)) for q in survey.brightness_quantiles]

    def apply(self, state: State) -> None:
        state.image = torch.minimum(state.image, self.value("iof", state))
