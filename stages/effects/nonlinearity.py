"""The detector's response is bent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class Nonlinearity(Effect):
    name = "nonlinearity"
    slot = "sensor"
    title = "nonlinear response"
    mechanism = (
        "Well capacity, companding tables and film bend the response: measured = I + quadratic I^2 + log I ln I. The second term "
        "is what a small change of gamma does."
    )
    reference = "Humm et al. (2016), Space Sci. Rev. 200, 431 (nonlinearity of the LROC NACs near the dark level)"
    confused_with = ("phase_slope", "opposition_surge", "saturation")
    separate = "an image of the same ground at another exposure time"
    parameters = (
        Parameter("quadratic", "1", -10.0, 10.0, 0.0, "coefficient of I^2, per unit of I/F"),
        Parameter("log", "1", -0.5, 0.5, 0.0, "coefficient of I ln I"),
    )
    possible = "a response that rises, nowhere four times as steep as elsewhere"
    strong: ClassVar = {"quadratic": 1.0, "log": 0.05}

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        quadratic, log = {"quadratic": 0.02 / survey.brightness}, {"log": 0.02}
        return [Trial((quadratic,)), Trial((log,)), Trial((quadratic, log))]

    @classmethod
    def plausible(cls, values: Mapping[str, float], survey: Survey) -> bool:
        """A response that rises, by half to twice as much as a straight one, over the brightness that the data have."""
        levels = [0.2 * survey.brightness, survey.brightness, max(survey.brightness_quantiles)]
        rise = [1 + 2 * values["quadratic"] * x + values["log"] * (1 + math.log(max(x, 1e-6))) for x in levels]
        return min(rise) > 0 and max(rise) < 4 * min(rise)

    def apply(self, state: State) -> None:
        image = state.image
        bend = self.value("quadratic", state) * image * image
        state.image = image + bend + self.value("log", state) * image * torch.log(image.clamp(min=1e-6))
