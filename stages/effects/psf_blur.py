"""The optics are less sharp than assumed."""

from __future__ import annotations

from typing import ClassVar

from stages.effects.base import Effect, register
from stages.effects.filters import gaussian
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class PsfBlur(Effect):
    name = "psf_blur"
    slot = "sensor"
    title = "blur beyond the nominal optics"
    mechanism = (
        "Defocus, diffraction, smear by motion and the resampling of map projection widen the point-spread function by a Gaussian. "
        "Optics with a contrast of 0.1 at the Nyquist frequency add 0.4 to the pixel's own, bilinear resampling up to a sixth: less than 0.6 is not "
        "reported. No image is sharper than its pixels."
    )
    reference = "Humm et al. (2016), Space Sci. Rev. 200, 431 (point-spread function of the LROC NACs)"
    confused_with = ("dem_smoothing", "misregistration")
    separate = "an image with cast shadows, whose edges the DEM's resolution does not soften"
    parameters = (Parameter("sigma2_px2", "px2", -0.1, 6.0, 0.0, "variance added to the point-spread function"),)
    strong: ClassVar = {"sigma2_px2": 1.0}
    tried: ClassVar = {"sigma2_px2": 0.5}
    tolerance: ClassVar = {"sigma2_px2": 0.6}
    in_simulation: ClassVar = {"sigma2_px2": -0.25}

    def apply(self, state: State) -> None:
        state.image = gaussian(state.image, self.value("sigma2_px2", state))
