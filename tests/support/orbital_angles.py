"""Angles of rough ground as orbital images see it."""

from __future__ import annotations

import numpy as np


def orbital_cosines(rng: np.random.Generator, sun: np.ndarray, slope: float, count: int) -> np.ndarray:
    """Cosines (3, N) of incidence, emission and phase, one image for each Sun.

    sun : (n,) elevations, rad; slope : rms of either component, as tangent; count : facets per image
    """
    parts = []
    for elevation in sun:
        view, azimuth = np.radians(rng.uniform(0, 35)), rng.uniform(0, 2 * np.pi)
        s = np.array([np.cos(elevation), 0, np.sin(elevation)])
        v = np.array([np.sin(view) * np.cos(azimuth), np.sin(view) * np.sin(azimuth), np.cos(view)])
        normal = np.concatenate([-rng.normal(0, slope, (count, 2)), np.ones((count, 1))], 1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        mu0, mu = normal @ s, normal @ v
        seen = (mu0 > np.cos(np.radians(76))) & (mu > 0.3)
        parts.append(np.stack([mu0[seen], mu[seen], np.full(seen.sum(), s @ v)]))
    return np.concatenate(parts, 1)
