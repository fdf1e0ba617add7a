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
    bounds = {p.name: (p.lower, p.upper) for p in model.parameters}
    variance = torch.zeros_like(angles.cos_incidence)
    for name, sigma in deviations.items():
        low, high = bounds[name]
        above, below = ((values[name] + s).clamp(low, high) for s in (sigma, -sigma))
        change = masked_radiance_factor(model, {**values, name: above}, angles)
        change = change - masked_radiance_factor(model, {**values, name: below}, angles)
        # a bound shortens the step of 2 sigma
        share = 2 * sigma / (above - below).clamp(min=1e-12)
        variance = variance + (change * 0.5 * share).square()
    return variance.sqrt()
