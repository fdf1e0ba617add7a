"""A pedestal under every image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from stages.effects.base import Effect, Survey, Trial, register, telling_share
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class DarkBias(Effect):
    name = "dark_bias"
    slot = "sensor"
    lights_shadows = True
    title = "dark level and stray light"
    mechanism = "Dark current, electronic offset and veiling stray light add the same amount to every pixel, in shadow as in light."
    reference = (
        "Humm et al. (2016), Space Sci. Rev. 200, 431; stray light: Mahanti et al. (2016), Space Sci. Rev. 200, 393"
    )
    confused_with = ("earthshine", "interreflection", "nonlinearity")
    separate = "an image with deep shadow, where nothing else is bright"
    parameters = (Parameter("iof", "1", -0.1, 0.1, 0.0, "added I/F, truth minus given"),)
    strong: ClassVar = {"iof": 0.004}
    possible = "-10 to 50 % of the brightness"
    tolerance: ClassVar = {
        "iof": 1e-4
    }  # half a step of 12 bits, and the stray light of good optics: 0.1 % of a bright scene

    @classmethod
    def plausible(cls, values: Mapping[str, float], survey: Survey) -> bool:
        """No detector is clipped below nothing by a tenth of the signal, nor lit up by half of it."""
        return -0.1 * survey.brightness < values["iof"] < 0.5 * survey.brightness

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"iof": 0.02 * survey.brightness},))]

    def apply(self, state: State) -> None:
        # on lit ground light that is always added is a term of the law
        state.image = state.image + self.value("iof", state) * telling_share(state)
