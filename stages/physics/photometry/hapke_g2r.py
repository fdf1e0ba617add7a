"""The Moon's Hapke law that comes with the reference implementation of Lunar-G2R (its baseline).

A mixture of Hapke's papers, with three parameters and no roughness:

    I/F = (1 - gamma^2)/4 cos(i)/(cos(i) + cos(e)) [ (1 + B(g)) p(g) + H(cos i) H(cos e) - 1 ]
    p = 4 pi/5 [ (sin g + (pi - g) cos g)/pi + (1 - cos g)^2/10 ]             Hapke (1966)
    B = B0 [ 1 - t/2 (3 - exp(-1/t)) (1 - exp(-1/t)) ], t = tan(g)/h; 0 beyond 90 deg     Hapke (1963)
    H(x) = (1 + 2 x) / (1 + 2 x gamma)                                       Hapke (1981), gamma = sqrt(1 - w)
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, register


@register
class HapkeG2R(ReflectanceModel):
    name = "hapke_g2r"
    default_maps = ("gamma",)
    title = "Hapke of the Lunar-G2R reference implementation"
    formula = "(1 - gamma^2)/4 cos(i)/(cos(i) + cos(e)) [(1 + B) p + H(cos i) H(cos e) - 1]"
    reference = (
        "Hapke, B. (1963), J. Geophys. Res. 68, 4571; (1966), Astron. J. 71, 333; (1981), J. Geophys. Res. 86, 3039"
    )
    reciprocal = True
    parameters = (
        Parameter("h", "1", 0.01, 2.0, 0.4, "width of the opposition surge"),
        Parameter("gamma", "1", 0.0, 1.0, 0.9, "sqrt(1 - w), w the single-scattering albedo"),
        Parameter("B0", "1", 0.0, 2.0, 1.0, "amplitude of the opposition surge"),
    )
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  float g = phase_angle(cos_g), gamma = p[1], surge = 0.0;
  float particle = (sin(g) + (PI - g) * cos_g) / PI + 0.1 * (1.0 - cos_g) * (1.0 - cos_g);
  if (cos_g > 0.0) {
    float t = clamp(sin(g) / (max(p[0], 1e-6) * cos_g), 1e-3, 1e3), fall = exp(-1.0 / t);
    // 1 - exp(-1/t) loses its digits where 1/t is small
    float rise = t > 30.0 ? (1.0 - 0.5 / t * (1.0 - 1.0 / (3.0 * t))) / t : 1.0 - fall;
    surge = 1.0 - 0.5 * t * (3.0 - fall) * rise;
  }
  float multiple = (1.0 + 2.0 * mu0) / (1.0 + 2.0 * mu0 * gamma) * (1.0 + 2.0 * mu) / (1.0 + 2.0 * mu * gamma) - 1.0;
  float single = (1.0 + p[2] * surge) * particle * 0.8 * PI;
  return (1.0 - gamma * gamma) / 4.0 * mu0 / (mu0 + mu) * (single + multiple);
}
"""

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        mu0, mu, cos_phase, phase = angles.cos_incidence, angles.cos_emission, angles.cos_phase, angles.phase
        gamma = parameters["gamma"]
        sin_phase = phase.sin()
        particle = (sin_phase + (math.pi - phase) * cos_phase) / math.pi + 0.1 * (1 - cos_phase) ** 2
        # The surge in t = tan(g)/h, between bounds beyond which it is B0 or 0 to machine precision.
        ahead = cos_phase > 0
        t = sin_phase / (parameters["h"].clamp(min=1e-6) * torch.where(ahead, cos_phase, torch.ones_like(cos_phase)))
        t = t.clamp(min=1e-3, max=1e3) if cos_phase.dtype == torch.float32 else t.clamp(min=1e-9, max=1e6)
        fall = torch.exp(-1 / t)
        surge = 1 - 0.5 * t * (3 - fall) * -torch.expm1(-1 / t)
        surge = torch.where(ahead, surge, torch.zeros_like(surge))
        multiple = (1 + 2 * mu0) / (1 + 2 * mu0 * gamma) * (1 + 2 * mu) / (1 + 2 * mu * gamma) - 1
        single = (1 + parameters["B0"] * surge) * particle * (0.8 * math.pi)
        return (1 - gamma * gamma) / 4 * mu0 / (mu0 + mu) * (single + multiple)
