"""The empirical laws that the LROC team normalises its mosaics with, in their forms of 2014 and 2019.

    2014: I/F = exp(A0 + A1 g + A2 cos(e) + A3 cos(i))
    2019: I/F = cos(i) / (cos(i) + cos(e)) exp(B0 + B1 g^2 + B2 g + B3 sqrt(g) + B4 cos(e) + B5 cos(i) + B6 cos(i)^2)

with g in degrees. The defaults are the published sets for the NAC (broadband, 600 nm). The law of 2014 does not fall to
0 at incidence 90 deg, and neither is reciprocal.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, register


def _terms(*rows: tuple[str, str, float, str]) -> tuple[Parameter, ...]:
    """Parameters between 0 and twice the published value. rows : name, unit, value, term"""
    return tuple(
        Parameter(name, unit, value - abs(value), value + abs(value), value, f"in the exponent: {term}")
        for name, unit, value, term in rows
    )


@register
class LrocEmpirical2014(ReflectanceModel):
    name = "lroc_empirical_2014"
    title = "LROC empirical, 2014"
    formula = "exp(A0 + A1 g + A2 cos(e) + A3 cos(i)), g in deg"
    reference = "LROC team: ISIS lronacpho, algorithm LROC_Empirical, version 2014 (NAC_PHO_LROC_Empirical.0002)"
    reciprocal = False
    parameters = _terms(
        ("A0", "1", -2.9811422, "constant"),
        ("A1", "1/degree", -0.0112862, "phase"),
        ("A2", "1", -0.8084603, "cos(e)"),
        ("A3", "1", 1.3248888, "cos(i)"),
    )
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  return exp(p[0] + p[1] * degrees(phase_angle(cos_g)) + p[2] * mu + p[3] * mu0);
}
"""

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        a0, a1, a2, a3 = (parameters[p.name] for p in self.parameters)
        return torch.exp(a0 + a1 * torch.rad2deg(angles.phase) + a2 * angles.cos_emission + a3 * angles.cos_incidence)


@register
class LrocEmpirical2019(ReflectanceModel):
    name = "lroc_empirical_2019"
    title = "LROC empirical, 2019"
    formula = (
        "cos(i)/(cos(i) + cos(e)) exp(B0 + B1 g^2 + B2 g + B3 sqrt(g) + B4 cos(e) + B5 cos(i) + B6 cos(i)^2), g in deg"
    )
    reference = "LROC team: ISIS lronacpho, algorithm LROC_Empirical, version 2019 (NAC_PHO_LROC_Empirical.0003)"
    reciprocal = False
    parameters = _terms(
        ("B0", "1", -1.479654495, "constant"),
        ("B1", "1/degree^2", -0.000083528, "phase squared"),
        ("B2", "1/degree", 0.012964707, "phase"),
        ("B3", "1/degree^0.5", -0.237774774, "square root of phase"),
        ("B4", "1", 0.556075496, "cos(e)"),
        ("B5", "1", 0.663671460, "cos(i)"),
        ("B6", "1", -0.439918609, "cos(i)^2"),
    )
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  float g = degrees(phase_angle(cos_g));
  float exponent = p[0] + g * (p[2] + p[1] * g) + p[3] * sqrt(g) + p[4] * mu + mu0 * (p[5] + p[6] * mu0);
  return mu0 / (mu0 + mu) * exp(exponent);
}
"""

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        b0, b1, b2, b3, b4, b5, b6 = (parameters[p.name] for p in self.parameters)
        mu0, mu = angles.cos_incidence, angles.cos_emission
        g = torch.rad2deg(angles.phase)
        # the slope of sqrt(g) is infinite at 0; at 0 itself it is given as 0
        root = g.clamp(min=1e-20).sqrt()
        exponent = b0 + g * (b2 + b1 * g) + b3 * root + b4 * mu + mu0 * (b5 + b6 * mu0)
        return mu0 / (mu0 + mu) * torch.exp(exponent)
