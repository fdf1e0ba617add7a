"""The detector's columns respond unequally."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, register
from stages.physics.detector.readout import COLUMN_ORDERS as ORDERS
from stages.physics.detector.readout import column_wave
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter


@register
class ColumnPattern(Effect):
    name = "column_pattern"
    slot = "sensor"
    linear = True
    title = "flat field over detector columns"
    mechanism = (
        "Vignetting, dust and an old flat field change the response smoothly along the detector's row of pixels, the same in every "
        "image: cosines over the samples. Files without `detector_sample` take the crop's columns."
    )
    reference = "Humm et al. (2016), Space Sci. Rev. 200, 431 (flat field of the LROC NACs)"
    confused_with = ("albedo_map",)
    separate = "an image of the same ground with the detector's row lying across it in another direction"
    parameters = (Parameter("rms", "1", 0.0, 1.0, 0.0, "rms of the response about 1"),)
    coordinates = tuple(Parameter(f"c{k}", "1", -0.5, 0.5, 0.0, f"cosine {k} over the columns") for k in ORDERS)
    strong: ClassVar = {p.name: 0.02 for p in coordinates}
    tolerance: ClassVar = {"rms": 0.001}  # of a good flat field

    def response(self, count: int) -> Tensor:
        """Response at ``count`` samples from the first to the last column, (count,)."""
        u = (torch.arange(count) + 0.5) / count
        return torch.ones(count) + sum(float(self.values[f"c{k}"]) * column_wave(k, u, torch.cos) for k in ORDERS)

    def curves(self) -> dict[str, tuple[Tensor, str]]:
        return {"column_response": (self.response(256), "column")}

    @classmethod
    def report(cls, values: Mapping[str, float], errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        size = math.sqrt(sum(v * v for v in values.values()))
        error = math.sqrt(sum((v * errors.get(k, 0.0)) ** 2 for k, v in values.items())) / max(size, 1e-12)
        return {"rms": (size, error)}

    def columns(self, state: State) -> Tensor:
        sample = state.observation.detector_sample
        if sample is None:
            return torch.arange(state.elevation.shape[-1], dtype=state.elevation.dtype)
        return torch.nan_to_num(sample)

    def apply(self, state: State) -> None:
        first, last = self.survey.columns
        u = ((self.columns(state) - first + 0.5) / max(last - first + 1, 1)).clamp(0, 1)
        factor = torch.ones_like(state.image)
        for k in ORDERS:
            factor = factor + self.value(f"c{k}", state) * column_wave(k, u, torch.cos)
        state.image = state.image * factor
