"""A film or a scanner changes its response over a frame."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from stages.effects.base import Effect, Survey, Values, register
from stages.effects.fields import BROAD_ORDERS, broad_field, read_cosines
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class FrameField(Effect):
    name = "frame_field"
    slot = "sensor"
    scope = "pair"
    table = ("frame_field", "field_term")
    linear = True
    title = "response that varies over a frame"
    mechanism = (
        "Film is developed unevenly, lenses darken their corners and scanners drift: within a frame the response changes smoothly, another "
        "way in every frame. Low cosines over each crop of it, for images in dn, whose gain and offset are free anyway."
    )
    reference = "Lawrence et al. (2015), 46th LPSC, 2694 (scanned film of the Apollo metric camera)"
    confused_with = ("column_pattern", "albedo_map")
    separate = "crops of the same frame from elsewhere in it"
    parameters = (Parameter("rms", "1", 0.0, 1.0, 0.0, "rms of the response about its mean in a crop"),)
    coordinates = tuple(
        Parameter(f"f{m}{n}", "1", -0.5, 0.5, 0.0, f"cosine {m} down, {n} across") for m, n in BROAD_ORDERS
    )
    strong: ClassVar = {p.name: 0.02 for p in coordinates}
    tolerance: ClassVar = {"rms": 0.01}

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return survey.units == "dn"

    @classmethod
    def read_off_image(cls, own: Tensor, seen: Tensor) -> tuple[Values, Tensor, Tensor]:
        """Cosines of what an image has of its own. own, seen : (images, H, W), as of :meth:`Effect.read_off_image`"""
        amounts, size, finer = read_cosines(own, seen)
        return {p.name: amounts[:, k].float() for k, p in enumerate(cls.coordinates)}, size, finer

    def apply(self, state: State) -> None:
        amounts = [self.value(p.name, state) for p in self.coordinates]
        state.image = state.image * (1 + broad_field(amounts, *state.image.shape[-2:]))
