"""Optics scatter some of the light far, and into shadows."""

from __future__ import annotations

from typing import ClassVar

import torch

from stages.effects.base import Effect, register, telling_share
from stages.effects.filters import filtered
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

CORE = 4.0  # px, within which it is a matter of the blur


@register
class StrayLight(Effect):
    name = "stray_light"
    listed = False
    slot = "sensor"
    linear = True
    lights_shadows = True
    title = "light that the optics scatter far, into shadows"
    mechanism = (
        "The wings of a point spread function fall with the cube of the distance, those of a perfect aperture as well: a few per cent of the light "
        "arrive more than some pixels away, and are seen where it is dark."
    )
    reference = "Born & Wolf (1999), Principles of Optics, sect. 8.5 (wings); Mahanti et al. (2016), Space Sci. Rev. 200, 393 (stray light)"
    confused_with = ("dark_bias", "earthshine", "interreflection")
    separate = "a shadow wide enough to be dark in its middle"
    parameters = (Parameter("share", "1", 0.0, 0.5, 0.0, "of the light that arrives farther away"),)
    strong: ClassVar = {"share": 0.02}
    tolerance: ClassVar = {"share": 0.05}  # a perfect aperture that is sampled by 1.3 px per wavelength over diameter

    def apply(self, state: State) -> None:
        # exp(-CORE k) is the transform of CORE / (2 pi (r^2 + CORE^2)^(3/2))
        wings = filtered(state.image, lambda waves: torch.exp(-CORE * waves))
        state.image = state.image + self.value("share", state) * wings * telling_share(state)
