"""A broad pattern of albedo that terrain does not tell."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from stages.effects.base import Effect, Values, register
from stages.effects.fields import BROAD_ORDERS, broad_field, read_cosines
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class AlbedoMap(Effect):
    name = "albedo_map"
    slot = "reflectance"
    linear = True
    scope = "site"
    table = ("site_albedo", "term")
    title = "broad albedo pattern (rays, mare borders)"
    mechanism = (
        "Crater rays, swirls and mare borders change albedo over tens of pixels without a trace in the terrain: a low-order cosine "
        "field per site. Reported only where it stands out above the red spectrum of ordinary texture."
    )
    reference = "Hawke et al. (2004), Icarus 170, 1 (lunar rays)"
    confused_with = ("elevation_albedo", "slope_albedo")
    separate = "neighbouring sites: the pattern goes on across their borders, whatever the terrain"
    parameters = (Parameter("per_std", "1", 0.0, 1.0, 0.0, "rms of the field, relative to albedo"),)
    coordinates = tuple(
        Parameter(f"c{m}{n}", "1", -0.5, 0.5, 0.0, f"cosine {m} down, {n} across") for m, n in BROAD_ORDERS
    )
    strong: ClassVar = {p.name: 0.05 for p in coordinates}
    # broad brightness within 64 to 128 px of a NAC frame of mare at nadir (M143947267L) varies by 2 to 7 % outside its fresh craters
    tolerance: ClassVar = {"per_std": 0.08}

    @classmethod
    def read_off_ground(cls, albedo: Tensor, seen: Tensor) -> tuple[Values, Tensor, Tensor]:
        """Cosines of albedo; what a spectrum as steep as that of ground would have of them, going by finer ones, is ordinary.

        albedo, seen : (sites, H, W), as of :meth:`Effect.read_off_ground`
        """
        amounts, size, usual = read_cosines(albedo, seen)
        return {p.name: amounts[:, k].float() for k, p in enumerate(cls.coordinates)}, size, usual

    def apply(self, state: State) -> None:
        amounts = [self.value(p.name, state) for p in self.coordinates]
        state.reflectance = state.reflectance * (1 + broad_field(amounts, *state.elevation.shape[-2:]))
