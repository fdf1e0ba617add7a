"""The surface brightens steeply towards phase zero."""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class OppositionSurge(Effect):
    name = "opposition_surge"
    slot = "reflectance"
    of_law = True
    title = "opposition surge"
    mechanism = (
        "Grains hide their own shadows when the Sun stands behind the observer: reflectance is multiplied by "
        "1 + B0 / (1 + tan(g/2) / h)."
    )
    reference = "Hapke (1986), Icarus 67, 264; lunar maps: Sato et al. (2014), JGR 119, 1775"
    confused_with = ("phase_slope", "nonlinearity")
    separate = "an image at phase angle below 10 deg"
    parameters = (
        Parameter("B0", "1", -0.9, 4.0, 0.0, "amplitude"),
        Parameter("h", "1", 0.005, 0.5, 0.06, "angular width, as tan(g/2)"),
    )
    strong: ClassVar = {"B0": 1.0}
    shaped = ("h",)

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"B0": 0.3},), {"h": h}) for h in (0.03, 0.06, 0.12)]

    def apply(self, state: State) -> None:
        cosine = state.angles.cos_phase.clamp(-1 + 1e-6, 1)
        tangent = torch.sqrt(((1 - cosine) / (1 + cosine)).clamp(min=1e-12))
        state.reflectance = state.reflectance * (1 + self.value("B0", state) / (1 + tangent / self.value("h", state)))
