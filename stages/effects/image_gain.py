"""Each image has its own scale."""

from __future__ import annotations

from typing import ClassVar

from stages.effects.base import Effect, Survey, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class ImageGain(Effect):
    name = "image_gain"
    slot = "radiance"
    scope = "image"
    table = ("image_gain", None)
    always = 0.5
    scatters = True
    about_mean = True
    title = "calibration scale of single images"
    mechanism = (
        "Exposure, temperature and decay of the detector leave every image with its own scale error. Images in dn have a free "
        "gain anyway, so they cannot show it."
    )
    reference = "Humm et al. (2016), Space Sci. Rev. 200, 431 (radiometric calibration of the LROC NACs)"
    confused_with = ("phase_slope", "opposition_surge", "azimuthal_anisotropy", "column_pattern")
    separate = "more images than there are phase angles and Sun azimuths in play"
    parameters = (Parameter("rms", "1", 0.0, 1.0, 0.0, "rms of the gains about their mean"),)
    coordinates = (Parameter("gain", "1", -0.9, 4.0, 0.0, "relative gain of an image"),)
    strong: ClassVar = {"gain": 0.02}
    tolerance: ClassVar = {"rms": 0.01}  # images of one calibration agree to about a hundredth

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return survey.units == "iof"

    def apply(self, state: State) -> None:
        state.radiance = state.radiance * (1 + self.value("gain", state))
