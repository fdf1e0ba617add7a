"""Minnaert's law: limb darkening by one exponent; k = 1 is Lambert, the Moon at small phase has k = 0.5.

    I/F = albedo cos(i)^k cos(e)^(k-1)

The albedo is the normal albedo; k rises with phase, and with k < 1 the law is infinite at the limb.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ALBEDO, Parameter, ReflectanceModel, register


@register
class Minnaert(ReflectanceModel):
    name = "minnaert"
    default_maps = ("albedo",)
    title = "Minnaert"
    formula = "A cos(i)^k cos(e)^(k-1)"
    reference = "Minnaert, M. (1941), Astrophys. J. 93, 403"
    reciprocal = True
    parameters = (ALBEDO, Parameter("k", "1", 0.0, 2.0, 0.6, "exponent; for k < 1 the law breaks down at the limb"))
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  return p[0] * mu0 * exp(log(mu0 * mu) * (p[1] - 1.0));
}
"""

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        mu0, mu = angles.cos_incidence, angles.cos_emission
        # one logarithm and one exponential, where mu0^k mu^(k-1) would take two powers
        return parameters["albedo"] * mu0 * ((mu0 * mu).log() * (parameters["k"] - 1)).exp()
