"""Brightness depends on emission, as Lommel and Seeliger found."""

from __future__ import annotations

from typing import ClassVar

from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class LimbDarkening(Effect):
    name = "limb_darkening"
    slot = "reflectance"
    of_law = True
    title = "limb darkening (Lommel-Seeliger share)"
    mechanism = (
        "A dark particulate surface scatters once: brightness goes as mu0 / (mu0 + mu) and not as mu0. A share L of reflectance "
        "is multiplied by 2 / (mu0 + mu)."
    )
    reference = "McEwen (1991), Icarus 92, 298 (lunar-Lambert function)"
    confused_with = ("macroscopic_roughness", "phase_slope")
    separate = "an oblique image, at emission above 50 deg"
    parameters = (Parameter("share", "1", -1.0, 1.5, 0.0, "share of Lommel-Seeliger"),)
    strong: ClassVar = {"share": 0.3}
    possible = "a departure of less than 0.3 from the nominal law: one that is larger is another law"
    largest: ClassVar = {"share": 0.3}  # half of the measured laws are 0.25 to 0.45 from M2

    def apply(self, state: State) -> None:
        total = (state.angles.cos_incidence.clamp(min=0) + state.angles.cos_emission.clamp(min=0)).clamp(min=0.05)
        state.reflectance = state.reflectance * (1 + self.value("share", state) * (2 / total - 1))
