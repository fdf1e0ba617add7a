"""How finely a page keeps coefficients: in as few steps as leave I/F what it is."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import masked_radiance_factor
from stages.view.layers import Content
from stages.view.packing import spread_step

LEVELS = (64, 128, 256, 512)  # of the range between a coefficient's 1st and 99th percentiles
MANY = 8  # coefficients that vary: fewer start at the second of LEVELS
ENOUGH = 1e-3  # relative RMS error of I/F
SAMPLE = 20_000  # pixels
# incidence, emission, phase, deg
VIEWS = ((30.0, 0.0, 30.0), (60.0, 0.0, 60.0), (75.0, 30.0, 60.0), (85.0, 0.0, 85.0))


def choose_steps(content: Content, mapped: NDArray[np.bool_]) -> tuple[int, list[float], float]:
    """The fewest LEVELS that are ENOUGH, each coefficient's step, and the relative RMS error of I/F that they leave.

    mapped : (H, W), where every coefficient is known
    """
    every = max(1, int(mapped.sum()) // SAMPLE)
    values = np.stack([layer.values[mapped][::every].astype(float) for layer in content.coefficients])
    lowest = np.array([layer.values[mapped].min() for layer in content.coefficients], float)[:, None]
    exact = _pictures(content, values)
    level, steps, error = 0, np.empty(0), np.inf
    varying = int((np.ptp(values, axis=1) > 0).sum())
    for level in LEVELS[varying <= MANY :]:
        steps = np.array([spread_step(layer.values, mapped, level) for layer in content.coefficients])
        kept = lowest + steps[:, None] * np.rint((values - lowest) / steps[:, None])
        error = float(np.sqrt(np.mean(((_pictures(content, kept) - exact) / exact.mean(axis=1, keepdims=True)) ** 2)))
        if error <= ENOUGH:
            break
    return level, [float(s) for s in steps], error


def _pictures(content: Content, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """I/F (VIEWS, N) of coefficients (C, N)."""
    named = content.model.unpack(torch.from_numpy(values), 0)
    seen = [Angles.from_angles(*(torch.tensor(np.radians(a)) for a in view)) for view in VIEWS]
    return np.stack([masked_radiance_factor(content.model, named, angles).numpy() for angles in seen])
