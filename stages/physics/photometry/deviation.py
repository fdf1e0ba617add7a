"""From standard deviations of a model's parameters to that of its I/F, to first order, for independent errors:

var(I/F) = sum over parameters of (dI/dp sigma_p)^2
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ReflectanceModel, masked_radiance_factor

if TYPE_CHECKING:
    from torch import Tensor


def radiance_deviation(
    model: ReflectanceModel, values: Mapping[str, Tensor], deviations: Mapping[str, Tensor], angles: Angles
) -> Tensor:
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
        # at a bound the step is shorter than from -sigma to +sigma
        share = 2 * sigma / (above - below).clamp(min=1e-12)
        variance = variance + (change * 0.5 * share).square()
    return variance.sqrt()
