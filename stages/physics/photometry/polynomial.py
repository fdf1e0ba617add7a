"""The cosine polynomials M1..M5 of Lunar-G2R: I/F as a low-order polynomial in cos(i) and cos(g).

Grethen et al., "Lunar-G2R: Geometry-to-Reflectance Learning for High-Fidelity Lunar BRDF Estimation", table 1. The
paper's polynomials give r up to a constant factor and contain cos(incidence) already, so here they are I/F:

    M1  a cos(i) + b cos(g)
    M2  a cos(i) + b cos(g) + c
    M3  a cos(i) + b cos(g) + c cos(i) cos(g) + d
    M4  a cos(i) + b cos(g) + c cos(i)^2 + d
    M5  a cos(i) + b cos(g) + c cos(g)^2 + d
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from typing import ClassVar

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, register


class CosinePolynomial(ReflectanceModel):
    reference = "Grethen et al., Lunar-G2R, table 1"
    linear = True
    finite = True


def coefficient(name: str, of: str, default: float) -> Parameter:
    """A coefficient of a cosine: dimensionless, with bounds far beyond what the Moon needs."""
    return Parameter(name, "1", -1.0, 2.0, default, f"coefficient of {of}")


class IncidencePhasePolynomial(CosinePolynomial):
    """I/F = sum of coefficient x cos(i)^p x cos(g)^q, with one (p, q) per parameter in ``powers``."""

    reciprocal = False
    powers: ClassVar[tuple[tuple[int, int], ...]]

    def __init_subclass__(cls) -> None:
        terms = [" * ".join([f"p[{k}]"] + m * ["mu0"] + n * ["cos_g"]) for k, (m, n) in enumerate(cls.powers)]
        cls.glsl = (
            f"float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {{ return {' + '.join(terms)}; }}"
        )

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        terms = []
        for parameter, (p, q) in zip(self.parameters, self.powers, strict=True):
            factors = [parameters[parameter.name]] + p * [angles.cos_incidence] + q * [angles.cos_phase]
            terms.append(functools.reduce(operator.mul, factors))
        return functools.reduce(operator.add, terms)


@register
class M1(IncidencePhasePolynomial):
    name = "M1"
    title = "Lunar-G2R M1"
    formula = "a cos(i) + b cos(g)"
    powers = ((1, 0), (0, 1))
    parameters = (coefficient("a", "cos(i)", 0.06), coefficient("b", "cos(g)", 0.02))


@register
class M2(IncidencePhasePolynomial):
    name = "M2"
    title = "Lunar-G2R M2"
    formula = "a cos(i) + b cos(g) + c"
    powers = (*M1.powers, (0, 0))
    parameters = (*M1.parameters, coefficient("c", "1", 0.01))


@register
class M3(IncidencePhasePolynomial):
    name = "M3"
    title = "Lunar-G2R M3"
    formula = "a cos(i) + b cos(g) + c cos(i) cos(g) + d"
    powers = (*M1.powers, (1, 1), (0, 0))
    parameters = (*M1.parameters, coefficient("c", "cos(i) cos(g)", 0.01), coefficient("d", "1", 0.01))


@register
class M4(IncidencePhasePolynomial):
    name = "M4"
    title = "Lunar-G2R M4"
    formula = "a cos(i) + b cos(g) + c cos(i)^2 + d"
    powers = (*M1.powers, (2, 0), (0, 0))
    parameters = (*M1.parameters, coefficient("c", "cos(i)^2", 0.01), coefficient("d", "1", 0.01))


@register
class M5(IncidencePhasePolynomial):
    name = "M5"
    title = "Lunar-G2R M5"
    formula = "a cos(i) + b cos(g) + c cos(g)^2 + d"
    powers = (*M1.powers, (0, 2), (0, 0))
    parameters = (*M1.parameters, coefficient("c", "cos(g)^2", 0.01), coefficient("d", "1", 0.01))
