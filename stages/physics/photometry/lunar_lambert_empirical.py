"""The empirical Lunar-Lambert polynomial of stereo shape-from-shading (Ames Stereo Pipeline, `sfs`).

    I/F = albedo [ 2 L mu0/(mu0 + mu) + (1 - L) mu0 ] (exp(-C1 g) + C2),   L = O + A g + B g^2 + C g^3

with g in degrees in L and in radians in the exponential, as there. With C1 = C2 = 0 and McEwen's O, A, B, C it is
McEwen's law, which is negative beyond some 105 deg of phase: the polynomial is not valid there.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ALBEDO, Parameter, ReflectanceModel, register
from stages.physics.photometry.lunar_lambert import GLSL_MIXTURE, MCEWEN, lunar_share, mixture


@register
class LunarLambertEmpirical(ReflectanceModel):
    name = "lunar_lambert_empirical"
    default_maps = ("albedo",)
    title = "Lunar-Lambert, empirical polynomial of ASP"
    formula = "A [2 L cos(i)/(cos(i) + cos(e)) + (1 - L) cos(i)] (exp(-C1 g) + C2), L = O + A g + B g^2 + C g^3"
    reference = "Alexandrov, O. and Beyer, R. A. (2018), Earth Space Sci. 5, 652; Lohse, V. et al. (2006)"
    reciprocal = True
    parameters = (
        ALBEDO,
        Parameter("O", "1", -1.0, 3.0, MCEWEN[0], "L at phase 0"),
        Parameter("A", "1/degree", -0.1, 0.1, MCEWEN[1], "linear term of L"),
        Parameter("B", "1/degree^2", -1e-3, 1e-3, MCEWEN[2], "quadratic term of L"),
        Parameter("C", "1/degree^3", -1e-5, 1e-5, MCEWEN[3], "cubic term of L"),
        Parameter("C1", "1/rad", 0.0, 10.0, 0.0, "decay of the phase factor"),
        Parameter("C2", "1", 0.0, 10.0, 0.0, "constant of the phase factor"),
    )
    glsl = (
        GLSL_MIXTURE
        + """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  float g = phase_angle(cos_g);
  float share = lunar_share(g, vec4(p[1], p[2], p[3], p[4]));
  return p[0] * mixture(share, mu0, mu) * (exp(-p[5] * g) + p[6]);
}
"""
    )

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        share = lunar_share(angles.phase, tuple(parameters[k] for k in "OABC"))
        factor = torch.exp(-parameters["C1"] * angles.phase) + parameters["C2"]
        return parameters["albedo"] * mixture(share, angles) * factor
