"""M6 of Lunar-G2R: a polynomial in Rusinkiewicz' half and difference angles.

With s the direction of the Sun, v that of the camera, n the normal and h = (s + v)/|s + v|:

    theta_h  angle between h and n            cos = (cos i + cos e) / (2 cos(g/2))
    theta_d  angle between h and s            cos = cos(g/2)
    phi_h    azimuth of h about n, from the tangent t = the Sun's direction projected on the surface
    phi_d    azimuth of s about h, from the plane of n and h

The frame follows the Sun, so M6 is an isotropic function of (i, e, g). With D = (n . (s x v))^2 and
P = sin^2(i) + cos(g) - cos(i) cos(e):

    cos(phi_h) = P / sqrt(P^2 + D)
    cos(phi_d) = q / sqrt(q^2 + D),  q = cos(g/2) (cos e - cos i)

Where theta is 0 its azimuth is not defined; a term of machine precision under the root makes both cosines go smoothly to 0.

Supplement of Grethen et al., Lunar-G2R, section 2; Rusinkiewicz (1998), Eurographics Workshop on Rendering, 11. The authors' code
does not normalise h and takes the camera's direction as tangent, so its coefficients do not carry over.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import register
from stages.physics.photometry.polynomial import CosinePolynomial, coefficient


def half_difference_cosines(angles: Angles) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """cos(theta_h), cos(theta_d), cos(phi_h), cos(phi_d) as in the module's text; finite for every input."""
    mu0, mu, cos_phase = angles.cos_incidence, angles.cos_emission, angles.cos_phase
    epsilon = torch.finfo(mu0.dtype).eps
    cos_half = (0.5 + 0.5 * cos_phase).clamp(min=epsilon).sqrt()
    mu0_squared = mu0 * mu0
    cosine = cos_phase - mu0 * mu  # sin(i) sin(e) cos(azimuth)
    volume = ((1 - mu0_squared) * (1 - mu * mu) - cosine * cosine).clamp(min=0) + epsilon
    p = 1 - mu0_squared + cosine
    q = cos_half * (mu - mu0)
    cos_theta_h = ((mu0 + mu) * 0.5 / cos_half).clamp(max=1)  # over 1 only for angles that no directions have
    return cos_theta_h, cos_half, p * torch.rsqrt(p * p + volume), q * torch.rsqrt(q * q + volume)


@register
class M6(CosinePolynomial):
    name = "M6"
    title = "Lunar-G2R M6"
    formula = "a cos(theta_h) + b cos(theta_d) + c cos(phi_h) + d cos(phi_d)"
    reference = "Grethen et al., Lunar-G2R, table 1 and supplement; angles: Rusinkiewicz (1998)"
    reciprocal = False
    parameters = (
        coefficient("a", "cos(theta_h)", 0.04),
        coefficient("b", "cos(theta_d)", 0.02),
        coefficient("c", "cos(phi_h)", 0.005),
        coefficient("d", "cos(phi_d)", 0.005),
    )
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  float cos_half = sqrt(max(0.5 + 0.5 * cos_g, 1.2e-7)), cosine = cos_g - mu0 * mu;
  float volume = max((1.0 - mu0 * mu0) * (1.0 - mu * mu) - cosine * cosine, 0.0) + 1.2e-7;
  float h = 1.0 - mu0 * mu0 + cosine, d = cos_half * (mu - mu0);
  float theta_h = min(0.5 * (mu0 + mu) / cos_half, 1.0);
  return p[0] * theta_h + p[1] * cos_half + p[2] * h * inversesqrt(h * h + volume) + p[3] * d * inversesqrt(d * d + volume);
}
"""

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        theta_h, theta_d, phi_h, phi_d = half_difference_cosines(angles)
        a, b, c, d = (parameters[p.name] for p in self.parameters)
        return a * theta_h + b * theta_d + c * phi_h + d * phi_d
