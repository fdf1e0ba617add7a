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
from torch import Tensor

from stages.physics.geometry import Angles


def rough_cosines(angles: Angles, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Effective cosines of incidence and emission, and the shadowing function S.

    theta : mean slope angle, rad; 0 gives the true cosines and S = 1
    returns mu0e, mue, S; finite, with finite gradients, wherever both cosines are above 0

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

    sun_higher = mu0 >= mu
    small_cos, large_cos = torch.maximum(mu0, mu), torch.minimum(mu0, mu)  # of the smaller and the larger angle
    small_sin = (1 - small_cos * small_cos).clamp(min=floor).sqrt()
    large_sin = (1 - large_cos * large_cos).clamp(min=floor).sqrt()

    product = small_sin * large_sin
    cosine = angles.cos_phase - mu0 * mu
    sin2 = (0.5 * (product - cosine) / product).clamp(min=tiny, max=1.0)  # sin^2(psi / 2)
    cos2 = (0.5 * (product + cosine) / product).clamp(min=tiny, max=1.0)
    half_sin, half_cos = sin2.sqrt(), cos2.sqrt()
    psi_over_pi = torch.atan2(half_sin, half_cos) * (2 / math.pi)
    shade = torch.exp(-2 * half_sin / half_cos)

    e1_small, e2_small = _facets(small_cos / small_sin, cot_theta)
    e1_large, e2_large = _facets(large_cos / large_sin, cot_theta)
    eta_small = chi * (small_cos + small_sin * tan_theta * e2_small / (2 - e1_small))
    eta_large = chi * (large_cos + large_sin * tan_theta * e2_large / (2 - e1_large))
    tilt = tan_theta / (2 - e1_large - psi_over_pi * e1_small).clamp(min=1e-6)
    effective_small = chi * (small_cos + small_sin * tilt * ((cos2 - sin2) * e2_large + sin2 * e2_small))
    effective_large = chi * (large_cos + large_sin * tilt * (e2_large - sin2 * e2_small))
    effective_small = effective_small.clamp(min=1e-12)
    effective_large = effective_large.clamp(min=1e-12)

    mu0e = torch.where(sun_higher, effective_small, effective_large)
    mue = torch.where(sun_higher, effective_large, effective_small)
    eta0 = torch.where(sun_higher, eta_small, eta_large)
    eta = torch.where(sun_higher, eta_large, eta_small)
    visible = 1 - shade + shade * chi * small_cos / eta_small
    return mu0e, mue, mue * mu0 * chi / (eta * eta0 * visible)


def _facets(cot_angle: Tensor, cot_theta: Tensor) -> tuple[Tensor, Tensor]:
    """E1 = exp(-2/pi cot(theta) cot(x)) and E2 = exp(-cot^2(theta) cot^2(x) / pi); both are 0 beyond the clamp."""
    ratio = (cot_angle * cot_theta).clamp(max=60.0)
    return torch.exp(-2 / math.pi * ratio), torch.exp(-ratio * ratio / math.pi)
