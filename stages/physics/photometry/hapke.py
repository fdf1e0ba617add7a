"""Hapke's bidirectional reflectance in full, with a double Henyey-Greenstein phase function.

    I/F = K w/4 mu0e / (mu0e + mue) [ p(g) (1 + Bs0 Bs(g)) + H(mu0e/K) H(mue/K) - 1 ] (1 + Bc0 Bc(g)) S(i, e, g)

Single-particle phase function (Hapke 2012; c as in Sato et al. 2014, its first lobe scatters backward):

    p(g) = (1 + c)/2 (1 - b^2) / (1 - 2 b cos g + b^2)^(3/2) + (1 - c)/2 (1 - b^2) / (1 + 2 b cos g + b^2)^(3/2)

Opposition effect by shadow hiding (Hapke 1986) and coherent backscatter (Hapke 2002), each with its own width:

    Bs(g) = 1 / (1 + tan(g/2)/hs)
    Bc(g) = [1 + (1 - exp(-x))/x] / [2 (1 + x)^2],  x = tan(g/2)/hc

Multiple scattering, by the approximation of 2002 (default) or of 1981 (models named h1981):

    H(x) = 1 / (1 - w x [r0 + (1 - 2 r0 x)/2 ln((1 + x)/x)]),  r0 = (1 - sqrt(1 - w)) / (1 + sqrt(1 - w))
    H(x) = (1 + 2 x) / (1 + 2 x sqrt(1 - w))

Porosity (Hapke 2008), with phi the filling factor; K = 1 at phi = 0:

    K = -ln(1 - 1.209 phi^(2/3)) / (1.209 phi^(2/3))

Effective cosines mu0e, mue and shadowing S: macroscopic roughness of mean slope theta, see below.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, register
from stages.physics.photometry.roughness import GLSL_ROUGH_SURFACE, rough_surface

# Defaults: Sato et al. (2014), 643 nm, mean over the Moon (set "sato2014_643nm" of `published.py`).
OPTIONAL = (
    Parameter("Bs0", "1", 0.0, 4.0, 1.70638, "amplitude of the shadow-hiding opposition effect"),
    Parameter("hs", "1", 0.001, 1.0, 0.05431, "angular width of shadow hiding, as tan(g/2)"),
    Parameter("Bc0", "1", 0.0, 1.0, 0.0, "amplitude of the coherent-backscatter opposition effect"),
    Parameter("hc", "1", 0.001, 1.0, 1.0, "angular width of coherent backscatter, as tan(g/2)"),
    Parameter("theta", "rad", 0.0, math.radians(60), math.radians(23.6566), "mean slope of macroscopic roughness"),
    Parameter("phi", "1", 0.0, 0.7, 0.0, "filling factor; 0 = no porosity correction (K = 1)"),
)

# Parameters by position: w, b, c, then OPTIONAL
GLSL_BODY = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  float w = p[0], tangent = tan(min(0.5 * phase_angle(cos_g), 0.5 * PI - 1e-3));
  vec3 rough = rough_surface(mu0, mu, cos_g, p[7]);
  float surge = p[4] / max(p[4] + tangent, 1e-12);
  float y = 1.209 * pow(clamp(p[8], 1e-20, 0.75), 2.0 / 3.0);
  float k = y < 1e-3 ? 1.0 + y * (0.5 + y / 3.0) : -log(1.0 - y) / y;
  float single = phase_function(p[1], p[2], cos_g) * (1.0 + p[3] * surge);
  float multiple = multiple_scattering(rough.x / k, w) * multiple_scattering(rough.y / k, w) - 1.0;
  float x = tangent / max(p[6], 1e-9);
  float mean = x < 1e-2 ? 1.0 - x / 2.0 * (1.0 - x / 3.0) : (1.0 - exp(-x)) / x;
  float backscatter = 1.0 + p[5] * (1.0 + mean) / (2.0 * (1.0 + x) * (1.0 + x));
  return (single + multiple) * rough.x * rough.y / (rough.x + rough.y) * rough.z * k * w / 4.0 * backscatter;
}
"""
GLSL_HENYEY_GREENSTEIN = """
float phase_function(float b, float c, float cos_g) {
  float backward = pow(max(1.0 - 2.0 * b * cos_g + b * b, 1e-12), -1.5);
  float forward = pow(max(1.0 + 2.0 * b * cos_g + b * b, 1e-12), -1.5);
  return (1.0 - b * b) * 0.5 * ((1.0 + c) * backward + (1.0 - c) * forward);
}
"""
GLSL_H = {
    "1981": """
float multiple_scattering(float x, float w) {
  return (1.0 + 2.0 * x) / (1.0 + 2.0 * x * sqrt(max(1.0 - w, 1e-12)));
}
""",
    "2002": """
float multiple_scattering(float x, float w) {
  float gamma = sqrt(max(1.0 - w, 1e-12)), r0 = (1.0 - gamma) / (1.0 + gamma);
  x = max(x, 1e-12);
  return 1.0 / (1.0 - w * x * (r0 + (0.5 - r0 * x) * log(1.0 + 1.0 / x)));
}
""",
}


def henyey_greenstein(cos_phase: torch.Tensor, b: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
    """Double Henyey-Greenstein phase function: (1 + c)/2 in the backward lobe (about g = 0), (1 - c)/2 forward.

    cos_phase : (...,); b, c : broadcastable with it
    """
    b2 = b * b
    backward = (1 - 2 * b * cos_phase + b2).clamp(min=1e-12) ** -1.5
    forward = (1 + 2 * b * cos_phase + b2).clamp(min=1e-12) ** -1.5
    return (1 - b2) * 0.5 * ((1 + c) * backward + (1 - c) * forward)


def shadow_hiding(tan_half_phase: torch.Tensor, hs: torch.Tensor) -> torch.Tensor:
    """Bs(g) = 1 / (1 + tan(g/2) / hs).

    tan_half_phase : (...,); hs : 1, broadcastable with it
    """
    return hs / (hs + tan_half_phase).clamp(min=1e-12)


def coherent_backscatter(tan_half_phase: torch.Tensor, hc: torch.Tensor) -> torch.Tensor:
    """Bc(g) = [1 + (1 - exp(-x)) / x] / [2 (1 + x)^2], x = tan(g/2) / hc; 1 at g = 0.

    tan_half_phase : (...,); hc : 1, broadcastable with it
    """
    x = tan_half_phase / hc.clamp(min=1e-9)
    small = x < 1e-2
    safe = torch.where(small, torch.ones_like(x), x)
    series = 1 - x / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5)))  # of (1 - exp(-x)) / x, to x^4
    mean = torch.where(small, series, -torch.expm1(-safe) / safe)
    return (1 + mean) / (2 * (1 + x) ** 2)


def porosity(phi: torch.Tensor) -> torch.Tensor:
    """K of the filling factor; 1 at phi = 0, where its one-sided slope is infinite and 0 is returned for it.

    phi : (...,), 0..1
    """
    y = 1.209 * phi.clamp(min=1e-20, max=0.75) ** (2 / 3)
    return -torch.log1p(-y) / y


def h_1981(x: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    """H(x) = (1 + 2 x) / (1 + 2 x sqrt(1 - w)) (Hapke 1981).

    x : (...,), a cosine; w : single-scattering albedo, broadcastable with it
    """
    gamma = (1 - w).clamp(min=1e-12).sqrt()
    return (1 + 2 * x) / (1 + 2 * x * gamma)


def h_2002(x: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    """H(x) = 1 / (1 - w x [r0 + (1 - 2 r0 x)/2 ln((1 + x)/x)]), r0 = (1 - sqrt(1-w)) / (1 + sqrt(1-w)) (Hapke 2002).

    x : (...,), a cosine; w : single-scattering albedo, broadcastable with it
    """
    gamma = (1 - w).clamp(min=1e-12).sqrt()
    r0 = (1 - gamma) / (1 + gamma)
    x = x.clamp(min=1e-12)
    return 1 / (1 - w * x * (r0 + (0.5 - r0 * x) * torch.log1p(1 / x)))


class HapkeBase(ReflectanceModel):
    """All of Hapke's model but the single-particle phase function."""

    reference = (
        "Hapke, B. (2012), Theory of Reflectance and Emittance Spectroscopy, 2nd ed.; roughness: (1984), Icarus 59, 41"
    )
    reciprocal = True
    default_maps = ("w", "b")
    h_function: ClassVar[str] = "2002"
    glsl_phase_function: ClassVar[str]

    def __init_subclass__(cls) -> None:
        if hasattr(cls, "glsl_phase_function"):
            cls.glsl = GLSL_ROUGH_SURFACE + GLSL_H[cls.h_function] + cls.glsl_phase_function + GLSL_BODY

    @abstractmethod
    def phase_function(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        """p(g) of single scattering, 1 on average over the sphere.

        parameters : by name, each broadcasting with the angles (...,)
        """

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        w = parameters["w"]
        mu_x, mu_y, shadowing = rough_surface(angles, parameters["theta"])
        half = 0.5 * angles.phase
        tangent = torch.tan(half.clamp(max=math.pi / 2 - (1e-7 if half.dtype == torch.float64 else 1e-3)))
        surge = shadow_hiding(tangent, parameters["hs"])
        single = self.phase_function(parameters, angles) * (1 + parameters["Bs0"] * surge)
        k = porosity(parameters["phi"])
        h = h_2002 if self.h_function == "2002" else h_1981
        multiple = h(mu_x / k, w) * h(mu_y / k, w) - 1
        # mu0e / (mu0e + mue) S, in which mu0e and mue may change places
        image = (single + multiple) * (mu_x * mu_y / (mu_x + mu_y) * shadowing) * (k * w / 4)
        if _is_off(parameters["Bc0"]):
            return image
        return image * (1 + parameters["Bc0"] * coherent_backscatter(tangent, parameters["hc"]))


def _is_off(amplitude: torch.Tensor) -> bool:
    """A single 0 that nothing is learnt about: its term need not be computed."""
    return amplitude.numel() == 1 and not amplitude.requires_grad and float(amplitude) == 0.0


class HapkeHenyeyGreenstein(HapkeBase):
    parameters = (
        Parameter("w", "1", 0.0, 1.0, 0.38138, "single-scattering albedo"),
        Parameter("b", "1", 0.0, 0.95, 0.23066, "asymmetry of both lobes of the phase function"),
        Parameter("c", "1", -1.0, 1.0, 0.40267, "backward minus forward share of the lobes (Hapke 2012, Sato 2014)"),
        *OPTIONAL,
    )
    glsl_phase_function = GLSL_HENYEY_GREENSTEIN

    def phase_function(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        return henyey_greenstein(angles.cos_phase, parameters["b"], parameters["c"])


@register
class Hapke(HapkeHenyeyGreenstein):
    name = "hapke"
    title = "Hapke, double Henyey-Greenstein, H of 2002"
    formula = "K w/4 mu0e/(mu0e + mue) [p (1 + Bs0 Bs) + H(mu0e/K) H(mue/K) - 1] (1 + Bc0 Bc) S"


@register
class HapkeH1981(HapkeHenyeyGreenstein):
    name = "hapke_h1981"
    title = "Hapke, double Henyey-Greenstein, H of 1981"
    formula = Hapke.formula
    h_function = "1981"
