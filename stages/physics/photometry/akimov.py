"""Akimov's disk function: the brightness over the disk of an extremely rough surface, with no limb brightening.

    D = cos(g/2) cos[pi/(pi - g) (L - g/2)] cos(B)^(eta g/(pi - g)) / cos(L)

L and B are photometric longitude and latitude: cos(e) = cos(B) cos(L), cos(i) = cos(B) cos(g - L). D is 1 at the
mirror point L = g/2, B = 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, register


@register
class Akimov(ReflectanceModel):
    name = "akimov"
    default_maps = ("albedo",)
    title = "Akimov disk function"
    formula = "A cos(g/2) cos[pi/(pi-g) (L - g/2)] cos(B)^(eta g/(pi-g)) / cos(L)"
    reference = "Akimov, L. A. (1976), Sov. Astron. 19, 385; Shkuratov, Y. et al. (2011), Planet. Space Sci. 59, 1326"
    reciprocal = True
    parameters = (
        Parameter("albedo", "1", 0.0, 1.0, 0.07, "equigonal albedo: I/F at the mirror point of the phase angle"),
        Parameter("eta", "1", 0.0, 1.0, 1.0, "latitude exponent: 1 = theory, about 0.5 lunar highlands, 0.3 maria"),
    )
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  float g = clamp(phase_angle(cos_g), 1e-3, PI - 1e-3);
  float sin_g = sin(g), across = mu0 - mu * cos(g), along = mu * sin_g, share = g / (PI - g);
  float d = clamp(atan(along, across), 1e-6, PI - 1e-4);
  float longitude = cos(share * d) + sin(share * d) / tan(d);
  float cos2_latitude = clamp((across * across + along * along) / (sin_g * sin_g), 1e-12, 1.0);
  return p[0] * cos(0.5 * g) * max(longitude, 0.0) * exp(0.5 * p[1] * share * log(cos2_latitude));
}
"""

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        mu0, mu = angles.cos_incidence, angles.cos_emission
        double = mu0.dtype == torch.float64
        # Nearer to 0 the longitude is noise, and D = 1 to the same precision; at pi the disk function ends.
        phase = angles.phase.clamp(min=1e-7 if double else 1e-3, max=math.pi - (1e-6 if double else 1e-3))
        sin_phase, cos_phase = phase.sin(), phase.cos()
        floor = 1e-24 if double else 1e-12
        across = mu0 - mu * cos_phase  # cos(B) sin(L) sin(g)
        along = mu * sin_phase  # cos(B) cos(L) sin(g)
        share = phase / (math.pi - phase)
        d = torch.atan2(along, across)
        # No direction above the horizon is within 1e-6 of d = 0 but where e = 90 deg; the floor keeps 1/tan finite.
        d = d.clamp(min=1e-6, max=math.pi - (1e-7 if double else 1e-4))
        # sin((1 + q) d) / sin(d) with q = g/(pi - g) and d = pi/2 - L, written without the 0/0 at the limb
        longitude = torch.cos(share * d) + torch.sin(share * d) / torch.tan(d)
        cos2_latitude = ((across * across + along * along) / (sin_phase * sin_phase)).clamp(min=floor, max=1.0)
        latitude = torch.exp(0.5 * parameters["eta"] * share * cos2_latitude.log())
        return parameters["albedo"] * torch.cos(0.5 * phase) * longitude.clamp(min=0.0) * latitude
