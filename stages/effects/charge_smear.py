"""Each column of a frame adds a share of its mean to all of its pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class ChargeSmear(Effect):
    name = "charge_smear"
    listed = False
    slot = "sensor"
    linear = True
    title = "light of a whole column in each of its pixels, as a frame that is read without a shutter has it"
    mechanism = (
        "A frame that is shifted through the light while it is read collects a share of what falls on all of the column. Of what lies beyond the "
        "crop nothing is known: it is taken to be as bright."
    )
    reference = "Caldwell et al. (2010), Astrophys. J. Lett. 713, L92 (a camera without a shutter)"
    confused_with = ("dark_bias", "column_pattern")
    separate = "a frame with deep shadow in some columns and sunlit ground in others"
    parameters = (Parameter("share", "1", -0.3, 0.5, 0.0, "of the column's mean brightness"),)
    coordinates = (*parameters, Parameter("axis", "1", -1.0, 1.0, 1.0, "1: of columns, -1: of lines"))
    possible = "light of columns; broad relief that the DEM has not looks like that of lines as well"
    strong: ClassVar = {"share": 0.03}
    one_sided: ClassVar = "axis"

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"share": 0.03},), {"axis": axis}) for axis in (1.0, -1.0)]

    @classmethod
    def plausible(cls, values: Mapping[str, float], survey: Survey) -> bool:
        """No camera adds up light along its lines."""
        return values["axis"] > 0

    def apply(self, state: State) -> None:
        observation, image = state.observation, state.image
        if float(self.values["axis"]) > 0:
            mean = column_means(image, observation.detector_sample)
        elif observation.detector_line is None:
            mean = image.mean(-1, keepdim=True).expand_as(image)
        else:
            mean = column_means(image, observation.detector_line)
        state.image = image + self.value("share", state) * mean


def column_means(image: Tensor, sample: Tensor | None) -> Tensor:
    """(B, H, W) of the detector's column that each pixel is of; of the crop's columns without ``sample`` (B, H, W)."""
    if sample is None:
        return image.mean(-2, keepdim=True).expand_as(image)
    known = torch.isfinite(sample)
    first = torch.where(known, sample, torch.inf).amin((-2, -1), keepdim=True)
    column = torch.where(known, sample - first, 0.0).round().long().flatten(1)
    total, count = torch.zeros(2, len(image), int(column.max()) + 1, dtype=image.dtype)
    total = total.scatter_add(1, column, torch.where(known, image, 0.0).flatten(1))
    count = count.scatter_add(1, column, known.to(image).flatten(1))
    return (total / count.clamp(min=1)).gather(1, column).view_as(image)
