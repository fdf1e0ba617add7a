"""The image lies beside the DEM."""

from __future__ import annotations

from typing import ClassVar

from stages.effects.base import Effect, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

ORDINARY = 0.3 * 2**0.5  # px, rms: 0.3 either way are normal


@register
class Misregistration(Effect):
    name = "misregistration"
    slot = "geometry"
    scope = "image"
    table = ("image_shift_px", "axis")
    always = 0.2
    scatters = True
    judged_apart = True
    displaces = True
    title = "image shifted against the DEM"
    mechanism = (
        "Errors of the spacecraft's position and pointing, or of the map projection, put every pixel of an image a fixed "
        "distance off the ground that the DEM gives it. Shifts under 0.3 px per axis are normal and not reported."
    )
    reference = "Speyerer et al. (2016), Space Sci. Rev. 200, 357 (LROC geometric calibration)"
    confused_with = ("line_jitter", "sun_azimuth")
    separate = "an image of the same ground under another Sun azimuth"
    parameters = (Parameter("rms_px", "px", 0.0, 10.0, 0.0, "rms length of the shifts"),)
    coordinates = (
        Parameter("east_px", "px", -5.0, 5.0, 0.0, "the pixel shows ground this many columns further east"),
        Parameter("south_px", "px", -5.0, 5.0, 0.0, "the pixel shows ground this many rows further south"),
    )
    strong: ClassVar = {"east_px": 0.5, "south_px": 0.5}
    tolerance: ClassVar = {"rms_px": ORDINARY}

    def apply(self, state: State) -> None:
        east, south = self.value("east_px", state), self.value("south_px", state)
        before = state.displacement or (0.0, 0.0)
        state.displacement = (before[0] + east, before[1] + south)
