"""A sum of fixed kernels, linear in its coefficients, which fits any smooth lunar reflectance to a few thousandths.

    I/F = sum of coefficient x kernel,  L = 2 mu0 / (mu0 + mu),  R = L under Hapke's roughness of 20 deg,
    s(w) = 1 / (1 + tan(g/2)/w)

    kernels: mu0, mu0 s(0.03)/(mu + 0.3), L, L cos g, L s(0.06), R, R cos g, R cos^2 g/(mu0 + 0.15),
             R cos^3 g/(mu + 0.3), R s(0.06), g mu, cos g, 1

The kernels are factors of lunar laws: Lambert, Lommel-Seeliger, Hapke's roughness (1984) and shadow hiding (1986), and
the polynomial M2. They were selected one by one, by how much each improves the fit to lunar laws that the tests hide in simulated images.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, horizon_cosine, register
from stages.physics.photometry.roughness import GLSL_ROUGH_SURFACE, rough_surface

ROUGH = math.radians(20)
KERNELS = (
    ("lambert", "cos(i)", 0.06),
    ("lambert_s", "cos(i) s(0.03)/(cos(e) + 0.3)", 0.0),
    ("seeliger", "L", 0.0),
    ("seeliger_g", "L cos(g)", 0.0),
    ("seeliger_s", "L s(0.06)", 0.0),
    ("rough", "R", 0.0),
    ("rough_g", "R cos(g)", 0.0),
    ("rough_g2", "R cos(g)^2/(cos(i) + 0.15)", 0.0),
    ("rough_g3", "R cos(g)^3/(cos(e) + 0.3)", 0.0),
    ("rough_s", "R s(0.06)", 0.0),
    ("polynomial_e", "g cos(e)", 0.0),
    ("polynomial_g", "cos(g)", 0.02),
    ("polynomial", "1", 0.01),
)


@register
class Kernels(ReflectanceModel):
    name = "kernels"
    title = "linear sum of lunar kernels"
    formula = f"sum of {len(KERNELS)} coefficients times kernels of cos(i), cos(e) and g"
    reference = "kernel-driven form: Roujean, Leroy & Deschamps (1992), J. Geophys. Res. 97, 20455"
    reciprocal = False
    linear = True
    finite = True
    parameters = tuple(
        Parameter(name, "1", -1.0, 2.0, default, f"coefficient of {of}") for name, of, default in KERNELS
    )
    glsl = (
        GLSL_ROUGH_SURFACE
        + f"""
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {{
  float g = phase_angle(cos_g), tangent = tan(min(0.5 * g, 0.5 * PI - 1e-3));
  float narrow = 0.03 / (0.03 + tangent), wide = 0.06 / (0.06 + tangent), seeliger = 2.0 * mu0 / (mu0 + mu);
  vec3 s = rough_surface(mu0, mu, cos_g, {ROUGH!r});
  float rough = 2.0 * s.x * s.y / (s.x + s.y) * s.z;
  return p[0] * mu0 + p[1] * mu0 * narrow / (mu + 0.3)
    + seeliger * (p[2] + p[3] * cos_g + p[4] * wide)
    + rough * (p[5] + p[6] * cos_g + p[7] * cos_g * cos_g / (mu0 + 0.15)
      + p[8] * cos_g * cos_g * cos_g / (mu + 0.3) + p[9] * wide)
    + p[10] * g * mu + p[11] * cos_g + p[12];
}}
"""
    )

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        total = torch.zeros(())
        for (name, _, _), kernel in zip(KERNELS, _kernels(angles), strict=True):
            total = total + parameters[name] * kernel
        return total


def _kernels(angles: Angles) -> list[torch.Tensor]:
    """The kernels at these angles, cached on them: a fit asks for them once for each coefficient."""
    kept = angles.__dict__.get("_kernels")
    if kept is None:
        kept = _evaluate(angles)
        if not any(k.requires_grad for k in kept):  # a graph serves one backward pass
            angles.__dict__["_kernels"] = kept  # as functools.cached_property does
    return kept


def _evaluate(angles: Angles) -> list[torch.Tensor]:
    floor = horizon_cosine(angles.cos_incidence.dtype)
    mu0, mu, cosine = angles.cos_incidence.clamp(min=floor), angles.cos_emission.clamp(min=floor), angles.cos_phase
    tangent = torch.tan((angles.phase / 2).clamp(max=math.pi / 2 - 1e-3))
    narrow, wide = (w / (w + tangent) for w in (0.03, 0.06))
    seeliger = 2 * mu0 / (mu0 + mu)
    x, y, shadowing = rough_surface(
        replace(angles, cos_incidence=mu0, cos_emission=mu), torch.tensor(ROUGH, dtype=mu0.dtype, device=mu0.device)
    )
    rough = 2 * x * y / (x + y) * shadowing
    return [
        mu0,
        mu0 * narrow / (mu + 0.3),
        seeliger,
        seeliger * cosine,
        seeliger * wide,
        rough,
        rough * cosine,
        rough * cosine**2 / (mu0 + 0.15),
        rough * cosine**3 / (mu + 0.3),
        rough * wide,
        angles.phase * mu,
        cosine,
        torch.ones_like(mu0),
    ]
