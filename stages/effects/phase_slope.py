"""Reflectance falls with phase angle faster or slower than modelled."""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class PhaseSlope(Effect):
    name = "phase_slope"
    slot = "reflectance"
    of_law = True
    title = "slope of the phase function"
    mechanism = "Grain size, opacity and maturity set how fast reflectance falls with the phase angle g: exp(-beta g)."
    reference = "Hicks et al. (2011), JGR 116, E00G15 (exponential phase functions of the Moon)"
    confused_with = ("opposition_surge", "nonlinearity", "image_gain")
    separate = "an image at phase angle below 10 deg, and one above 90 deg"
    parameters = (Parameter("per_radian", "1", -3.0, 3.0, 0.0, "beta in exp(-beta g)"),)
    strong: ClassVar = {"per_radian": 0.5}
    possible = "a departure of less than 0.5 from the nominal law: one that is larger is another law"
    largest: ClassVar = {"per_radian": 0.5}

    def apply(self, state: State) -> None:
        state.reflectance = state.reflectance * torch.exp(-self.value("per_radian", state) * state.angles.phase)
