"""Hapke's correction for macroscopic roughness, complete: effective cosines and shadowing function.

Hapke, B. (1984), Icarus 59, 41-59; as chapter 12 of Hapke (2012). Both his cases (incidence below or above emission) are
one formula in the smaller angle x and the larger angle y of the two, which is how it is written here. With psi the
azimuth between Sun and camera, cos(psi) = (cos g - cos i cos e) / (sin i sin e):

    chi   = 1 / sqrt(1 + pi tan^2(theta)),  f = exp(-2 tan(psi/2))
    E1(x) = exp(-2/pi cot(theta) cot(x)),   E2(x) = exp(-1/pi cot^2(theta) cot^2(x))
    eta(x) = chi [ cos x + sin x tan(theta) E2(x) / (2 - E1(x)) ]
    mu_x  = chi [ cos x + sin x tan(theta) (cos(psi) E2(y) + sin^2(psi/2) E2(x)) / (2 - E1(y) - psi/pi E1(x)) ]
    mu_y  = chi [ cos y + sin y tan(theta) (E2(y) - sin^2(psi/2) E2(x)) / (2 - E1(y) - psi/pi E1(x)) ]
    S     = mue/eta(e) cos(i)/eta(i) chi / (1 - f + f chi cos(x)/eta(x))

mu0e and mue are the mu of whichever angle is incidence and emission.
"""

from __future__ import annotations

import math

import torch

from stages.physics.formation.geometry import Angles

GLSL_ROUGH_SURFACE = """
vec2 facets(float cot_angle, float cot_theta) {
  float ratio = min(cot_angle * cot_theta, 60.0);
  return vec2(exp(-2.0 / PI * ratio), exp(-ratio * ratio / PI));
}
// mu_x, mu_y, S / mue
vec3 rough_surface(float mu0, float mu, float cos_g, float theta) {
  float tan_theta = tan(theta), cot_theta = 1.0 / max(tan_theta, 1e-4);
  float chi = inversesqrt(1.0 + PI * tan_theta * tan_theta);
  float cos_x = max(mu0, mu), cos_y = min(mu0, mu);
  float sin_x = sqrt(max(1.0 - cos_x * cos_x, 1e-10)), sin_y = sqrt(max(1.0 - cos_y * cos_y, 1e-10));
  float half_cosine = (cos_g - mu0 * mu) / (2.0 * sin_x * sin_y);
  float sin2 = clamp(0.5 - half_cosine, 1e-10, 1.0), cos2 = clamp(0.5 + half_cosine, 1e-10, 1.0);
  float tan_half = sqrt(sin2 / cos2), psi_over_pi = atan(tan_half) * 2.0 / PI, f = exp(-2.0 * tan_half);
  vec2 e_x = facets(cos_x / sin_x, cot_theta), e_y = facets(cos_y / sin_y, cot_theta);
  float tilt_x = sin_x * tan_theta, tilt_y = sin_y * tan_theta, hidden = sin2 * e_x.y;
  float between = max(2.0 - e_y.x - psi_over_pi * e_x.x, 1e-6);
  float mu_x = max(cos_x + tilt_x * ((cos2 - sin2) * e_y.y + hidden) / between, 1e-12);
  float mu_y = max(cos_y + tilt_y * (e_y.y - hidden) / between, 1e-12);
  float eta_x = cos_x + tilt_x * e_x.y / (2.0 - e_x.x), eta_y = cos_y + tilt_y * e_y.y / (2.0 - e_y.x);
  float visible = eta_x * (1.0 - f) + f * cos_x;
  return vec3(chi * mu_x, chi * mu_y, mu0 / (chi * eta_y * visible));
}
"""


def roughness_factor(angles: Angles, theta: torch.Tensor) -> torch.Tensor:
    """Reflectance of rough over that of smooth Lommel-Seeliger ground; 1 where the Sun or the camera is below the facet.

    angles : (...,) each; theta : () or (...,), mean slope angle, rad; returns (...,)
    """
    mu0, mu = angles.cos_incidence, angles.cos_emission
    x, y, shadowing = rough_surface(angles, theta)
    factor = shadowing * (x * y / (x + y)) / (mu0 / (mu0 + mu))
    return torch.where((mu0 > 1e-3) & (mu > 1e-3), factor, 1.0)


def rough_surface(angles: Angles, theta: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Effective cosines of the smaller and of the larger of incidence and emission, and S / mue.

    theta : mean slope angle, rad; 0 gives the true cosines and S = 1
    returns mu_x, mu_y, S / mue; finite, with finite gradients, wherever both cosines are above 0

    Hapke's reflectance needs no more: mu0e mue / (mu0e + mue) and H(mu0e) H(mue) are the same for (mu_x, mu_y).
    S is not differentiable in the azimuth psi at psi = 0 (f = exp(-2 tan(psi/2)) has a cusp there): the slope returned
    at that point is 0, the mean of both sides.
    """
    mu0, mu = angles.cos_incidence, angles.cos_emission
    double = mu0.dtype == torch.float64
    floor = 1e-20 if double else 1e-10  # of squared sines, so that cotangents and their gradients stay finite
    tiny = 1e-18 if double else 1e-10  # of sin^2 and cos^2 of half the azimuth
    tan_theta = torch.tan(theta)
    cot_theta = 1 / tan_theta.clamp(min=1e-6 if double else 1e-4)
    chi = torch.rsqrt(1 + math.pi * tan_theta * tan_theta)

    cos_x, cos_y = torch.maximum(mu0, mu), torch.minimum(mu0, mu)
    sin_x = (1 - cos_x * cos_x).clamp(min=floor).sqrt()
    sin_y = (1 - cos_y * cos_y).clamp(min=floor).sqrt()

    half_cosine = (angles.cos_phase - mu0 * mu) / (2 * sin_x * sin_y)  # cos(psi) / 2
    sin2 = (0.5 - half_cosine).clamp(min=tiny, max=1.0)  # sin^2(psi / 2)
    cos2 = (0.5 + half_cosine).clamp(min=tiny, max=1.0)
    tan_half = (sin2 / cos2).sqrt()
    psi_over_pi = torch.atan(tan_half) * (2 / math.pi)
    f = torch.exp(-2 * tan_half)

    e1_x, e2_x = _facets(cos_x / sin_x, cot_theta)
    e1_y, e2_y = _facets(cos_y / sin_y, cot_theta)
    tilt_x, tilt_y = sin_x * tan_theta, sin_y * tan_theta
    hidden = sin2 * e2_x
    between = (2 - e1_y - psi_over_pi * e1_x).clamp(min=1e-6)
    # chi is taken out of all four: mu_x, mu_y and both eta have it as a factor
    mu_x = (cos_x + tilt_x * ((cos2 - sin2) * e2_y + hidden) / between).clamp(min=1e-12)
    mu_y = (cos_y + tilt_y * (e2_y - hidden) / between).clamp(min=1e-12)
    eta_x = cos_x + tilt_x * e2_x / (2 - e1_x)
    eta_y = cos_y + tilt_y * e2_y / (2 - e1_y)
    # S / mue = cos(i) chi / (eta(e) eta(i) (1 - f + f chi cos(x)/eta(x)))
    visible = eta_x * (1 - f) + f * cos_x
    return chi * mu_x, chi * mu_y, mu0 / (chi * eta_y * visible)


def _facets(cot_angle: torch.Tensor, cot_theta: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """E1 = exp(-2/pi cot(theta) cot(x)) and E2 = exp(-cot^2(theta) cot^2(x) / pi); both are 0 beyond the clamp."""
    ratio = (cot_angle * cot_theta).clamp(max=60.0)
    return torch.exp(-2 / math.pi * ratio), torch.exp(-ratio * ratio / math.pi)
