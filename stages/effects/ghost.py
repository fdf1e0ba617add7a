"""A reflection between lenses lays the image over itself, turned and out of focus."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Survey, Trial, register
from stages.effects.fields import kept_axes
from stages.effects.filters import gaussian
from stages.physics.formation.chain import State
from stages.physics.formation.resampling import displace
from stages.physics.photometry import Parameter

OUT_OF_FOCUS = 4.0  # px2, variance: a ghost is sharp by chance only
TURNED, ACROSS_SAMPLES, ACROSS_LINES = 0.0, 1.0, 2.0


@register
class Ghost(Effect):
    name = "ghost"
    listed = False
    slot = "sensor"
    linear = True
    title = "a ghost of the image in itself, turned by 180 degrees or mirrored, as reflections between lenses leave it"
    mechanism = (
        "Light that is reflected twice between lenses, or by the detector and a lens, comes back on the other side of the optical axis. The axis is "
        "taken to be in the middle of the crop: what lies beyond the crop nobody knows."
    )
    reference = "Murray (1949), J. Opt. Soc. Am. 39, 30 (ghosts in optical systems)"
    confused_with = ("echo",)
    separate = "a frame with a bright edge on one side of its axis and level ground on the other"
    parameters = (Parameter("share", "1", -0.3, 0.5, 0.0, "of the light that is seen again"),)
    coordinates = (
        *parameters,
        Parameter("mirror", "1", 0.0, 2.0, 0.0, "0: turned by 180 deg, 1: samples, 2: lines the other way round"),
    )
    possible = "light that is added"
    strong: ClassVar = {"share": 0.05}
    tolerance: ClassVar = {"share": 0.003}

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"share": 0.03},), {"mirror": mirror}) for mirror in (TURNED, ACROSS_SAMPLES, ACROSS_LINES)]

    @classmethod
    def ordinary(cls, trial: Trial) -> float:
        """Nothing beside which other effects would be judged: most cameras have none."""
        return 0.0

    @classmethod
    def plausible(cls, values: Mapping[str, float], survey: Survey) -> bool:
        """No reflection takes light away."""
        return values["share"] > 0

    def apply(self, state: State) -> None:
        ghost = gaussian(self._mirrored(state), OUT_OF_FOCUS)
        state.image = state.image + self.value("share", state) * ghost

    def _mirrored(self, state: State) -> Tensor:
        image, mirror = state.image, float(self.values["mirror"])
        if mirror == TURNED:
            return image.flip(-2, -1)
        axis = kept_axes(state.observation, len(image))[int(mirror != ACROSS_SAMPLES)].to(image)
        axis = axis / axis.norm(dim=-1, keepdim=True)
        height, width = image.shape[-2:]
        y, x = torch.meshgrid(
            torch.arange(height) - (height - 1) / 2, torch.arange(width) - (width - 1) / 2, indexing="ij"
        )
        along = axis[:, 0, None, None] * x + axis[:, 1, None, None] * y
        return displace(image, -2 * along * axis[:, 0, None, None], -2 * along * axis[:, 1, None, None])
