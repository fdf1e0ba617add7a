"""How far the map of terrain alone may be wrong before any photograph is seen, from the network's standard deviations."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from stages.physics.formation.geometry import Angles
from stages.physics.maps.window import Box
from stages.physics.photometry import masked_radiance_factor
from stages.physics.photometry.deviation import radiance_deviation
from stages.physics.terrain.surface import Surface

INCIDENCE = math.radians(30)  # the standard geometry of laboratory and telescope: i = 30 deg, e = 0, g = 30 deg
LARGEST = 1.0  # relative variance: a deviation beyond the I/F itself says no more than that nothing is known


def terrain_variance(surface: Surface, box: Box) -> NDArray[np.float32] | None:
    """(h, w) variance of I/F relative to its square in the standard geometry; None where the map has no deviations."""
    row, col, height, width = box
    deviations = surface.read_deviations(row, col, height, width)
    if not deviations:
        return None
    coefficients = torch.from_numpy(np.ascontiguousarray(surface.read_coefficients(row, col, height, width)))
    values = surface.model.unpack(coefficients, dim=0)
    cosine, one = (torch.full((height, width), v) for v in (math.cos(INCIDENCE), 1.0))
    angles = Angles(cosine, one, cosine)
    spread = radiance_deviation(
        surface.model, values, {k: torch.from_numpy(v) for k, v in deviations.items()}, angles
    ).numpy()
    level = masked_radiance_factor(surface.model, values, angles).numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.where(level > 0, (spread / level) ** 2, LARGEST)
    return np.minimum(np.nan_to_num(variance, nan=0.0, posinf=LARGEST), LARGEST).astype(np.float32)
