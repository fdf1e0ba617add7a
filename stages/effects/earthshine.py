"""A second, faint, distant source of light."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register, telling_share
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class Earthshine(Effect):
    name = "earthshine"
    slot = "illumination"
    lights_shadows = True
    linear = True
    title = "light from the Earth or the sky"
    mechanism = (
        "The full Earth lights the near side with up to 1e-4 of the Sun; other distant sources act alike. Facets that face it "
        "gain radiance in proportion to the cosine, also in shadow."
    )
    reference = "Glenar et al. (2019), Icarus 321, 841 (earthshine as a light source for the lunar poles)"
    confused_with = ("dark_bias", "interreflection")
    separate = "an image in which shadows cover slopes of several directions"
    parameters = (
        Parameter("irradiance", "1", 0.0, 0.1, 0.0, "I/F of a facet that faces the source"),
        Parameter("elevation_deg", "degree", 0.0, 90.0, 90.0, "direction of the source"),
        Parameter("azimuth_deg", "degree", 0.0, 360.0, 0.0, "direction of the source, clockwise from north"),
    )
    coordinates = (
        Parameter("east", "1", -0.1, 0.1, 0.0, "irradiance times the direction's east component"),
        Parameter("north", "1", -0.1, 0.1, 0.0, "irradiance times the direction's north component"),
        Parameter("up", "1", 0.0, 0.1, 0.0, "irradiance times the direction's up component"),
    )
    possible = "a source above the horizon"
    strong: ClassVar = {"east": 0.004, "north": 0.004, "up": 0.004}
    tolerance: ClassVar = {"irradiance": 1e-4}  # of the full Earth, and of noise that is cut off at nothing in the dark

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        size = 0.02 * survey.brightness
        return [Trial(({"up": size}, {"east": size}, {"north": size}))]

    @classmethod
    def report(cls, values: Mapping[str, float], errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        vector = [values["east"], values["north"], values["up"]]
        spread = [errors.get(k, 0.0) for k in ("east", "north", "up")]
        size = math.sqrt(sum(v * v for v in vector))
        level = math.hypot(vector[0], vector[1])
        safe = max(size, 1e-12)
        error = math.sqrt(sum((v * s) ** 2 for v, s in zip(vector, spread, strict=True))) / safe
        turn = math.degrees(max(spread) / safe)
        return {
            "irradiance": (size, error),
            "elevation_deg": (math.degrees(math.atan2(vector[2], level)), turn),
            "azimuth_deg": (math.degrees(math.atan2(vector[0], vector[1])) % 360, turn * safe / max(level, 1e-12)),
        }

    @classmethod
    def plausible(cls, values: Mapping[str, float], survey: Survey) -> bool:
        """A source that is not below the horizon."""
        return values["up"] >= 0

    def apply(self, state: State) -> None:
        state.further_light.append(self._shine)

    def _shine(self, state: State) -> None:
        slope_east, slope_north = state.slopes
        cosine = torch.rsqrt(1 + slope_east**2 + slope_north**2)
        up, east, north = (self.value(n, state) for n in ("up", "east", "north"))
        if all(not torch.is_tensor(v) and v == 0 for v in self.values.values()):
            return
        facing = (up - slope_east * east - slope_north * north) * cosine
        # a facet turned away gets nothing; the sign of a single trial column is kept so that columns stay linear
        above = (up > 0) | ((east != 0) & (north != 0))
        light = torch.where(above, facing.clamp(min=0), facing)
        # what falls on all lit ground alike is a pedestal, or a term of the law
        state.radiance = state.radiance + light - (1 - telling_share(state)) * up * cosine
