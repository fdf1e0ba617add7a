"""The Lunar-Lambert (McEwen) law: a mixture of Lommel-Seeliger and Lambert whose share L falls with phase.

    I/F = albedo [ 2 L cos(i) / (cos(i) + cos(e)) + (1 - L) cos(i) ]

`lunar_lambert` takes McEwen's L(g); `lunar_lambert_fixed` has L as a parameter, so that it may also be a map or a
curve L(g) of the user's.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ALBEDO, Parameter, ReflectanceModel, register

# McEwen (1996): L(g) = 1 + A g + B g^2 + C g^3 with g in degrees; negative beyond 105 deg.
MCEWEN = (1.0, -0.019, 2.42e-4, -1.46e-6)

GLSL_MIXTURE = """
float lunar_share(float g, vec4 c) {
  float d = degrees(g);
  return c.x + d * (c.y + d * (c.z + d * c.w));
}
float mixture(float share, float mu0, float mu) { return mu0 * (1.0 + share * (2.0 / (mu0 + mu) - 1.0)); }
"""


def lunar_share(phase: torch.Tensor, coefficients: tuple = MCEWEN) -> torch.Tensor:
    """L(g) = O + A g + B g^2 + C g^3, the weight of the Lommel-Seeliger term.

    phase : (...,) rad
    coefficients : O, A, B, C for g in degrees, numbers or tensors
    """
    g = torch.rad2deg(phase)
    constant, linear, quadratic, cubic = coefficients
    return constant + g * (linear + g * (quadratic + g * cubic))


def mixture(share: torch.Tensor, angles: Angles) -> torch.Tensor:
    """2 L cos(i) / (cos(i) + cos(e)) + (1 - L) cos(i).

    share : L, (...,) as the angles
    """
    mu0 = angles.cos_incidence
    return mu0 * (1 + share * (2 / (mu0 + angles.cos_emission) - 1))


@register
class LunarLambert(ReflectanceModel):
    name = "lunar_lambert"
    title = "Lunar-Lambert, L(g) of McEwen"
    formula = (
        "A [2 L cos(i) / (cos(i) + cos(e)) + (1 - L) cos(i)], L = 1 - 0.019 g + 2.42e-4 g^2 - 1.46e-6 g^3 (g in deg)"
    )
    reference = "McEwen, A. S. (1996), Lunar Planet. Sci. XXVII, 841; (1991), Icarus 92, 298"
    reciprocal = True
    linear = True
    parameters = (ALBEDO,)
    glsl = (
        GLSL_MIXTURE
        + f"""
const vec4 MCEWEN = vec4({", ".join(map(repr, MCEWEN))});
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {{
  return p[0] * max(mixture(lunar_share(phase_angle(cos_g), MCEWEN), mu0, mu), 0.0);
}}
"""
    )

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        # The cubic makes I/F negative at large phase: 0 there, as in ISIS.
        return parameters["albedo"] * mixture(lunar_share(angles.phase), angles).clamp(min=0)


@register
class LunarLambertFixed(ReflectanceModel):
    name = "lunar_lambert_fixed"
    default_maps = ("albedo",)
    title = "Lunar-Lambert, L given"
    formula = "A [2 L cos(i) / (cos(i) + cos(e)) + (1 - L) cos(i)]"
    reference = "McEwen, A. S. (1991), Icarus 92, 298"
    reciprocal = True
    parameters = (ALBEDO, Parameter("L", "1", 0.0, 1.0, 0.5, "share of the Lommel-Seeliger term"))
    glsl = (
        GLSL_MIXTURE
        + """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) { return p[0] * mixture(p[1], mu0, mu); }
"""
    )

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        return parameters["albedo"] * mixture(parameters["L"], angles)
