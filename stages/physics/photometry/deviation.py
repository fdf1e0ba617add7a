"""Standard deviation of I/F from those of a model's parameters, to first order and for independent errors:

var(I/F) = sum over parameters of (dI/dp sigma_p)^2
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ReflectanceModel, masked_radiance_factor


def radiance_deviation(
    model: ReflectanceModel, values: Mapping[str, torch.Tensor], deviations: Mapping[str, torch.Tensor], angles: Angles
) -> torch.Tensor:
    """Standard deviation of I/F in full sunlight, of the shape of the angles.

    values : all parameters by name; deviations : of some of them, each broadcasting to the angles
    """
    variance = torch.zeros_like(angles.cos_incidence)
    for name, sigma in deviations.items():
        variance = variance + (sensitivity(model, values, name, sigma, angles) * sigma).square()
    return variance.sqrt()


def sensitivity(
    model: ReflectanceModel, values: Mapping[str, torch.Tensor], name: str, step: torch.Tensor | float, angles: Angles
) -> torch.Tensor:
    """Change of I/F per unit of the parameter ``name``, of the shape of the angles.

    values : all parameters by name; step : (...,) by which it changes either way, as far as its bounds allow; all
        broadcasting to the angles
    """
    low, high = next((p.lower, p.upper) for p in model.parameters if p.name == name)
    above, below = ((values[name] + s).clamp(low, high) for s in (step, -step))
    images = [masked_radiance_factor(model, {**values, name: value}, angles) for value in (above, below)]
    return (images[0] - images[1]) / (above - below).clamp(min=1e-12)
