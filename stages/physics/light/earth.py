"""Irradiance of the Moon by the Earth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

EARTH_RADIUS = 6371008.4  # m, mean
EARTH_DISTANCE = 384.4e6  # m, mean, between the centres
EARTH_GEOMETRIC_ALBEDO = 0.434  # NASA Earth fact sheet; 0.367 in the V band (Mallama et al. 2017, Icarus 282, 19)


def earth_irradiance(
    earth_phase: ArrayLike, distance: float = EARTH_DISTANCE, geometric_albedo: float = EARTH_GEOMETRIC_ALBEDO
) -> NDArray[np.float64]:
    """The Earth's irradiance on a facet that faces it, over the Sun's: the I/F of a white diffuse facet there.

    earth_phase : rad, angle Sun-Earth-Moon; 0 = full Earth, which is new Moon (pi minus the Moon's own phase angle)
    distance : m, to the facet

    p (R / d)^2 Phi(phase), with the phase function of a diffuse sphere (sin a + (pi - a) cos a) / pi. Clouds make the
    true Earth a few tens of per cent brighter or darker from day to day.

    returns the shape of ``earth_phase``, (...,)
    """
    phase = np.asarray(earth_phase, dtype=float)
    sphere = (np.sin(phase) + (math.pi - phase) * np.cos(phase)) / math.pi
    return geometric_albedo * (EARTH_RADIUS / distance) ** 2 * sphere


def earth_phase(sun: NDArray[np.float64], earth: NDArray[np.float64], place: NDArray[np.float64]) -> float:
    """rad, the angle at the Earth between the Sun and a place on the Moon; (3,) each, m, in the same axes."""
    to_sun, to_place = sun - earth, place - earth
    cosine = to_sun @ to_place / (np.linalg.norm(to_sun) * np.linalg.norm(to_place))
    return math.acos(max(-1.0, min(1.0, float(cosine))))
