"""A new effect with one value per image, in one file: motion blur along the lines, as long as each exposure was.

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
class MotionBlur(Effect):
    name = "motion_blur"
    slot = "sensor"
    scope = "image"
    title = "motion during the exposure"
    mechanism = (
        "The ground moves over the detector while a line is exposed: neighbouring lines mix, the more the longer."
    )
    reference = "Robinson et al. (2010), Space Sci. Rev. 150, 81 (exposure and ground motion of LROC)"
    confused_with = ("psf_blur", "line_jitter")
    separate = "an image of the same ground at a shorter exposure"
    parameters = (Parameter("rms", "1", 0.0, 1.0, 0.0, "rms of the shares of all images"),)
    coordinates = (Parameter("share", "1", 0.0, 1.0, 0.0, "of its light that a line gets from the two beside it"),)
    strong: ClassVar = {"share": 0.2}
    tolerance: ClassVar = {"rms": 0.1}  # what resampling onto the crops mixes

    def apply(self, state: State) -> None:
        wide = torch.nn.functional.pad(state.image[:, None], (0, 0, 1, 1), mode="replicate")[:, 0]
        beside = 0.5 * (wide[:, :-2] + wide[:, 2:])
        state.image = state.image + self.value("share", state) * (beside - state.image)


if __name__ == "__main__":
    rng = torch.Generator().manual_seed(1)
    relief = torch.randn(1, 16, 16, generator=rng).expand(2, 16, 16)
    sun, camera = torch.tensor([[0.0, 0.6, 0.8]] * 2), torch.tensor([[0.0, 5e4, 1e5]] * 2)
    rough = Observation(relief, sun, camera, 5.0, 1737400.0)
    rough.frame = torch.tensor([0, 1])  # which image each crop was cut from
    coefficients = torch.tensor([0.08, 0.02, 0.01])[None, :, None, None]
    blur = get_effect("motion_blur")({"share": torch.tensor([0.0, 0.4])})
    for name, effects in (("without", []), ("with", [blur])):
        first, second = form(rough, get_model("M2"), coefficients, effects).std((-2, -1))
        print(f"motion_blur {name}: I/F varies by {float(first):.5f} and {float(second):.5f}")
