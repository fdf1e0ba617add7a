"""The Earth as a light source for the Moon: how bright, and where it stands."""

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
    distance : m

    p (R / d)^2 Phi(phase), with the phase function of a diffuse sphere (sin a + (pi - a) cos a) / pi. Clouds make the
    true Earth a few tens of per cent brighter or darker from day to day.
    """
    phase = np.asarray(earth_phase, dtype=float)
    sphere = (np.sin(phase) + (math.pi - phase) * np.cos(phase)) / math.pi
    return geometric_albedo * (EARTH_RADIUS / distance) ** 2 * sphere


def earth_direction_enu(
    longitude: ArrayLike,
    latitude: ArrayLike,
    sub_earth_longitude: float = 0.0,
    sub_earth_latitude: float = 0.0,
    distance: float = EARTH_DISTANCE,
    body_radius: float = 1737400.0,
) -> NDArray[np.float64]:
    """(..., 3) unit vectors towards the Earth in east-north-up frames at places on the Moon.

    longitude, latitude : rad, east and planetocentric; sub_earth_... : rad, the optical libration (up to 8 and 7 deg)
    """
    longitude, latitude = np.broadcast_arrays(np.asarray(longitude, float), np.asarray(latitude, float))
    towards = distance * _unit(np.asarray(sub_earth_longitude), np.asarray(sub_earth_latitude))
    offset = towards - body_radius * _unit(longitude, latitude)
    offset /= np.linalg.norm(offset, axis=-1, keepdims=True)
    east = np.stack([-np.sin(longitude), np.cos(longitude), 0 * longitude], -1)
    up = _unit(longitude, latitude)
    north = np.cross(up, east)
    return np.stack([(offset * axis).sum(-1) for axis in (east, north, up)], -1)


def _unit(longitude: NDArray, latitude: NDArray) -> NDArray[np.float64]:
    return np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1)
