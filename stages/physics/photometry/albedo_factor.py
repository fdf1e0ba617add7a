"""A model with one further parameter, an albedo factor of its I/F, so that maps with albedo are rendered like all others.

It is not registered: no network predicts it, `lunargr albedo` makes such maps.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel

FACTOR = Parameter("albedo_factor", "1", 0.0, 100.0, 1.0, "I/F relative to that of the other parameters")
GLSL = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  return p[COUNT - 1] * without_albedo(p, mu0, mu, cos_g);
}
"""


class AlbedoFactor(ReflectanceModel):
    """``model`` with FACTOR as its last parameter."""

    def __init__(self, model: ReflectanceModel) -> None:
        self.model = model
        for key in ("name", "title", "reference", "reciprocal", "finite"):
            setattr(self, key, getattr(model, key))
        self.formula = f"{FACTOR.name} ({model.formula})"  # type: ignore[misc]
        self.parameters = (*model.parameters, FACTOR)  # type: ignore[misc]
        if model.glsl is not None:
            self.glsl = model.glsl.replace("float radiance_factor(", "float without_albedo(") + GLSL  # type: ignore[misc]

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        return self.model.radiance_factor(parameters, angles) * parameters[FACTOR.name]
