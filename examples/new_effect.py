"""A new effect in one file: haze that adds a veil growing with the path length through it.

Put a file like this into ``stages/effects/`` and `lunargr diagnose` tries it, lists it and explains it; here it is only
registered for this run. Run: python examples/new_effect.py
"""

from __future__ import annotations

import torch

from stages.effects import Effect, get_effect, register
from stages.physics.formation.chain import Observation, State, form
from stages.physics.photometry import Parameter, get_model


@register
class Haze(Effect):
    name = "haze"
    slot = "radiance"
    title = "veil of scattered light"
    mechanism = (
        "Dust lofted above the surface scatters sunlight into the camera, the more the longer the path through it."
    )
    reference = "a made-up example; see Horanyi et al. (2015), Nature 522, 324 for the real dust"
    confused_with = ("dark_bias",)
    separate = "an oblique image beside a vertical one"
    parameters = (Parameter("iof", "1", -0.05, 0.05, 0.0, "veil seen straight down"),)
    strong = {"iof": 0.002}  # noqa: RUF012 - never changed

    def apply(self, state: State) -> None:
        state.radiance = state.radiance + self.value("iof", state) / state.angles.cos_emission.clamp(min=0.1)


if __name__ == "__main__":
    flat = Observation(
        torch.zeros(1, 8, 8), torch.tensor([[0.0, 0.6, 0.8]]), torch.tensor([[0.0, 5e4, 1e5]]), 5.0, 1737400.0
    )
    coefficients = torch.tensor([0.08, 0.02, 0.01])[None, :, None, None]
    for veil in (0.0, 0.002):
        image = form(flat, get_model("M2"), coefficients, [get_effect("haze")({"iof": veil})])
        print(f"haze {veil}: mean I/F {float(image.mean()):.5f}")
