"""A new effect with one value per image, in one file: readout smear of a detector without a shutter.

Copy the class into ``stages/effects/``, and `lunargr diagnose` tries it, lists it and writes its values to ``frame_values`` of
diagnosis.h5; here it is only registered for this run. Run: python examples/new_effect_per_image.py
"""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects import Effect, get_effect, register
from stages.physics.formation.chain import Observation, State, form
from stages.physics.photometry import Parameter, get_model


@register
class ReadoutSmear(Effect):
    name = "readout_smear"
    slot = "sensor"
    scope = "image"
    title = "readout smear"
    mechanism = (
        "While lines are shifted out they go on collecting light: each column gets a share of its own mean added."
    )
    reference = "Hawkins et al. (2007), Space Sci. Rev. 131, 247 (MESSENGER's frame-transfer cameras)"
    confused_with = ("dark_bias",)
    separate = "an image whose columns are half in shadow"
    parameters = (Parameter("rms", "1", 0.0, 1.0, 0.0, "rms of the shares of all images"),)
    coordinates = (Parameter("share", "1", -0.2, 0.2, 0.0, "of a column's mean, added to its pixels"),)
    strong: ClassVar = {"share": 0.02}
    tolerance: ClassVar = {"rms": 0.002}

    def apply(self, state: State) -> None:
        state.image = state.image + self.value("share", state) * state.image.mean(-2, keepdim=True)


if __name__ == "__main__":
    east, north, up = torch.zeros(2), torch.tensor([0.6, -0.6]), torch.tensor([0.8, 0.8])
    flat = Observation(
        torch.zeros(2, 8, 8), torch.stack([east, north, up], 1), torch.tensor([[0.0, 5e4, 1e5]] * 2), 5.0, 1737400.0
    )
    flat.frame = torch.tensor([0, 1])  # which image each crop was cut from
    coefficients = torch.tensor([0.08, 0.02, 0.01])[None, :, None, None]
    smear = get_effect("readout_smear")({"share": torch.tensor([0.0, 0.02])})
    for name, effects in (("without", []), ("with", [smear])):
        first, second = form(flat, get_model("M2"), coefficients, effects).mean((-2, -1))
        print(f"readout_smear {name}: mean I/F {float(first):.5f} and {float(second):.5f}")
