"""Hapke's model with the single-particle phase function as two Legendre terms (ISIS HapkeLeg).

    p(g) = 1 + b cos(g) + c (3/2 cos^2(g) - 1/2)

and all else as in `hapke`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, register
from stages.physics.photometry.hapke import OPTIONAL, Hapke, HapkeBase

# Helfenstein and Veverka (1987), whole Moon; B0 = S(0) / (w p(0)) with S(0) = 0.71.
_LUNAR = {"w": 0.21, "Bs0": 0.71 / (0.21 * 1.68), "hs": 0.07, "theta": math.radians(20)}


def _lunar(parameter: Parameter) -> Parameter:
    return replace(parameter, default=_LUNAR.get(parameter.name, parameter.default))


class HapkeLegendreBase(HapkeBase):
    parameters = (
        _lunar(Hapke.parameters[0]),
        Parameter("b", "1", -1.0, 1.0, 0.29, "first Legendre coefficient of the phase function"),
        Parameter("c", "1", -1.0, 1.0, 0.39, "second Legendre coefficient of the phase function"),
        *(_lunar(p) for p in OPTIONAL),
    )
    glsl_phase_function = """
float phase_function(float b, float c, float cos_g) { return 1.0 + b * cos_g + c * (1.5 * cos_g * cos_g - 0.5); }
"""

    def phase_function(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        cos_phase = angles.cos_phase
        return 1 + parameters["b"] * cos_phase + parameters["c"] * (1.5 * cos_phase * cos_phase - 0.5)


@register
class HapkeLegendre(HapkeLegendreBase):
    name = "hapke_legendre"
    title = "Hapke, Legendre phase function, H of 2002"
    formula = Hapke.formula + ", p = 1 + b cos(g) + c (3/2 cos(g)^2 - 1/2)"


@register
class HapkeLegendreH1981(HapkeLegendreBase):
    name = "hapke_legendre_h1981"
    title = "Hapke, Legendre phase function, H of 1981 (ISIS HapkeLeg)"
    formula = HapkeLegendre.formula
    h_function = "1981"
