"""The DEM is smoother than the ground."""

from __future__ import annotations

from typing import ClassVar

from stages.effects.base import Effect, register
from stages.effects.filters import gaussian, plane, seams
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class DemSmoothing(Effect):
    name = "dem_smoothing"
    slot = "geometry"
    title = "DEM smoother (or rougher) than the ground"
    mechanism = (
        "Stereo correlation windows, laser footprints and interpolation blur relief: shading from the DEM lacks the contrast "
        "of short slopes. Undone by a Gaussian of the opposite variance, each frequency raised at most fourfold."
    )
    reference = "Henriksen et al. (2017), Icarus 283, 122 (resolution of LROC NAC DTMs)"
    confused_with = ("psf_blur", "dem_scale")
    separate = "an image at incidence above 60 deg, where shading is linear in slope but optics blur albedo as well"
    parameters = (
        Parameter("sigma2_px2", "px2", -2.0, 4.0, 0.0, "variance by which the DEM is smoother than the truth"),
    )
    strong: ClassVar = {"sigma2_px2": 1.0}
    tried: ClassVar = {"sigma2_px2": 0.5}
    # pixels that are means, and resampled, are smoother by a quarter; windows over which stereo is matched add as much and more
    tolerance: ClassVar = {"sigma2_px2": 0.7}
    in_simulation: ClassVar = {"sigma2_px2": 0.25}

    def apply(self, state: State) -> None:
        z = state.elevation
        sharp = seams(z)  # pieces are put together after they were smoothed
        sharp = sharp + plane(z - sharp)
        state.elevation = sharp + gaussian(z - sharp, -self.value("sigma2_px2", state), slopes=True)
