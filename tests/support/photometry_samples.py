"""Random geometry and parameters for the photometry tests and for the page that reports them."""

from __future__ import annotations

import math

import numpy as np

from stages.physics.photometry import evaluate, get_model
from stages.physics.photometry.quantities import to_brdf


def directions(rng, count, least=0.05):
    """Random pairs of directions above the surface: incidence, emission, phase (rad) and the azimuth between them."""
    cosines = rng.uniform(least, 1, (2, count))
    i, e = np.arccos(cosines)
    azimuth = rng.uniform(0.05, math.pi - 0.05, count)
    return i, e, np.arccos(np.cos(i) * np.cos(e) + np.sin(i) * np.sin(e) * np.cos(azimuth)), azimuth


def interior(model, rng, count):
    """Random parameters near the defaults, inside the bounds."""
    values = {}
    for p in model.parameters:
        low, high = p.default + 0.4 * (p.lower - p.default), p.default + 0.4 * (p.upper - p.default)
        values[p.name] = rng.uniform(low, high, count) + 1e-3 * (p.upper - p.lower)
    return values


def reciprocity_error(name, rng, count=2000):
    """Largest relative difference of the BRDF when Sun and camera change places."""
    i, e, g, _ = directions(rng, count, least=0.1)
    values = interior(get_model(name), rng, count)
    there = to_brdf(evaluate(name, values, i, e, g), np.cos(i))
    back = to_brdf(evaluate(name, values, e, i, g), np.cos(e))
    return float(np.max(np.abs(there - back) / np.maximum(np.abs(there) + np.abs(back), 1e-12)))
