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

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import leaky_relu

from stages.physics.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, register

SLOPE = 0.01  # of the LeakyReLU that keeps coefficients nearly positive, as in the authors' code


class CosinePolynomial(ReflectanceModel):
    """Coefficients are nearly positive: LeakyReLU(0.01) of the network's output."""

    reference = "Grethen et al., Lunar-G2R, table 1"
    linear = True
    finite = True

    def constrain(self, raw: Tensor, dim: int) -> Tensor:
        return leaky_relu(raw, SLOPE)

    def unconstrain(self, value: Tensor, dim: int) -> Tensor:
        return torch.where(value >= 0, value, value / SLOPE)


def coefficient(name: str, of: str, default: float) -> Parameter:
    """A coefficient of a cosine: dimensionless, bounded only for display."""
    return Parameter(name, "1", -1.0, 2.0, default, f"coefficient of {of}")


@register
class M1(CosinePolynomial):
    name = "M1"
    title = "Lunar-G2R M1"
    formula = "a cos(i) + b cos(g)"
    reciprocal = False
    parameters = (coefficient("a", "cos(i)", 0.06), coefficient("b", "cos(g)", 0.02))

    def radiance_factor(self, parameters: Mapping[str, Tensor], angles: Angles) -> Tensor:
        return parameters["a"] * angles.cos_incidence + parameters["b"] * angles.cos_phase


@register
class M2(CosinePolynomial):
    name = "M2"
    title = "Lunar-G2R M2"
    formula = "a cos(i) + b cos(g) + c"
    reciprocal = False
    parameters = (*M1.parameters, coefficient("c", "1", 0.01))

    def radiance_factor(self, parameters: Mapping[str, Tensor], angles: Angles) -> Tensor:
        return parameters["a"] * angles.cos_incidence + parameters["b"] * angles.cos_phase + parameters["c"]


@register
class M3(CosinePolynomial):
    name = "M3"
    title = "Lunar-G2R M3"
    formula = "a cos(i) + b cos(g) + c cos(i) cos(g) + d"
    reciprocal = False
    parameters = (*M1.parameters, coefficient("c", "cos(i) cos(g)", 0.01), coefficient("d", "1", 0.01))

    def radiance_factor(self, parameters: Mapping[str, Tensor], angles: Angles) -> Tensor:
        mu0, cos_phase = angles.cos_incidence, angles.cos_phase
        return parameters["a"] * mu0 + parameters["b"] * cos_phase + parameters["c"] * mu0 * cos_phase + parameters["d"]


@register
class M4(CosinePolynomial):
    name = "M4"
    title = "Lunar-G2R M4"
    formula = "a cos(i) + b cos(g) + c cos(i)^2 + d"
    reciprocal = False
    parameters = (*M1.parameters, coefficient("c", "cos(i)^2", 0.01), coefficient("d", "1", 0.01))

    def radiance_factor(self, parameters: Mapping[str, Tensor], angles: Angles) -> Tensor:
        mu0, cos_phase = angles.cos_incidence, angles.cos_phase
        return parameters["a"] * mu0 + parameters["b"] * cos_phase + parameters["c"] * mu0 * mu0 + parameters["d"]


@register
class M5(CosinePolynomial):
    name = "M5"
    title = "Lunar-G2R M5"
    formula = "a cos(i) + b cos(g) + c cos(g)^2 + d"
    reciprocal = False
    parameters = (*M1.parameters, coefficient("c", "cos(g)^2", 0.01), coefficient("d", "1", 0.01))

    def radiance_factor(self, parameters: Mapping[str, Tensor], angles: Angles) -> Tensor:
        mu0, cos_phase = angles.cos_incidence, angles.cos_phase
        return parameters["a"] * mu0 + parameters["b"] * cos_phase + parameters["c"] * cos_phase**2 + parameters["d"]
