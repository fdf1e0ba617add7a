"""Lambert's law: a surface equally bright from everywhere.

    I/F = albedo cos(i)

The albedo is that of a perfectly diffuse surface: 1 reflects all light.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ALBEDO, ReflectanceModel, register


@register
class Lambert(ReflectanceModel):
    name = "lambert"
    title = "Lambert"
    formula = "A cos(i)"
    reference = "Lambert, J. H. (1760), Photometria"
    reciprocal = True
    linear = True
    finite = True
    parameters = (ALBEDO,)
    glsl = "float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) { return p[0] * mu0; }"

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        return parameters["albedo"] * angles.cos_incidence
