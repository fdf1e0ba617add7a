"""Positions of asteroids and dwarf planets: published osculating elements, integrated to other times.

A two-body orbit would be off by a tenth of a degree within a few years; here the Sun and the planets (ERFA's plan94)
attract them. Over fifteen years the heliocentric direction stays within 0.0002 deg of elements published for other epochs
(tests/test_ephemeris_bodies.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from schemas.errors import InputError
from stages.common.arrays import Floats
from stages.physics.bodies.orientations import about_x, about_z

GAUSS = 0.01720209895  # au^1.5 / day: the Gaussian gravitational constant
OBLIQUITY_DEG = 84381.448 / 3600  # of the ecliptic of J2000 that orbital elements refer to (IAU 1976)
# Sun's mass over that of Mercury, Venus, Earth with Moon, Mars, Jupiter, Saturn, Uranus, Neptune (IAU 2009)
MASSES = np.array([6023600.0, 408523.71, 328900.56, 3098703.59, 1047.3486, 3497.898, 22902.98, 19412.24])
STRETCH = 512.0  # days that are integrated and kept at a time
SPAN = 40000.0  # days from the elements' epoch; farther away the last digits of the elements matter


@dataclass(frozen=True)
class Elements:
    """Osculating heliocentric elements, ecliptic and equinox of J2000.

    epoch : Julian date, TDB; angles in degrees; motion : mean daily motion, deg/day; source : who published them
    """

    epoch: float
    mean_anomaly: float
    perihelion: float
    node: float
    inclination: float
    eccentricity: float
    motion: float
    source: str

    def state(self) -> Floats:
        """(6,) heliocentric equatorial position, au, and velocity, au/day, at the epoch."""
        e, n = self.eccentricity, math.radians(self.motion)
        a = (GAUSS / n) ** (2 / 3)
        anomaly = mean = math.radians(self.mean_anomaly % 360.0)
        for _ in range(50):
            step = (anomaly - e * math.sin(anomaly) - mean) / (1 - e * math.cos(anomaly))
            anomaly -= step
            if abs(step) < 1e-15:
                break
        c, s = math.cos(anomaly), math.sin(anomaly)
        root = math.sqrt(1 - e * e)
        rate = n / (1 - e * c)
        plane = np.array([[a * (c - e), a * root * s, 0.0], [-a * s * rate, a * root * c * rate, 0.0]])
        turn = about_x(-OBLIQUITY_DEG) @ about_z(-self.node) @ about_x(-self.inclination) @ about_z(-self.perihelion)
        return np.asarray((plane @ turn.T).ravel(), float)


# Epochs near the missions that mapped them.
ELEMENTS = {
    "ceres": Elements(
        2457400.5, 181.38133, 72.73324, 80.32180, 10.59166, 0.0757544, 0.21400734, "MPCORB, MPO 370963, epoch K161D"
    ),
    "vesta": Elements(
        2455800.5, 56.40276, 149.88186, 103.90428, 7.13461, 0.0883124, 0.27164416, "MPCORB, MPO 135420, epoch K118R"
    ),
    "eros": Elements(
        2458276.5, 225.84280, 178.79852, 304.31681, 10.82826, 0.2226554, 0.55993406, "MPCORB, MPO 435698, epoch K1867"
    ),
    "bennu": Elements(
        2455562.5,
        101.703952002457,
        66.22306084084298,
        2.06086619569642,
        6.03494377024794,
        0.2037450762416414,
        math.degrees(GAUSS / 1.126391025894812**1.5),
        "JPL small-body database, solution 118",
    ),
}


def small_body_state(name: str, julian_date: float) -> tuple[Floats, Floats]:
    """Heliocentric position (3,), au, and velocity (3,), au/day, ICRF, at a Julian date (TDB). Raises InputError."""
    elements = ELEMENTS[name]
    if not abs(julian_date - elements.epoch) <= SPAN:
        raise InputError(
            f"body '{name}': expected a time within {SPAN / 365.25:.0f} years of its elements' epoch, JD {elements.epoch}, found "
            f"JD {julian_date:.1f}; give the sub-solar point."
        )
    days = julian_date - elements.epoch
    state = _stretch(name, math.floor(days / STRETCH) if days >= 0 else -math.ceil(-days / STRETCH))[1](days)
    return state[:3], state[3:]


@lru_cache(maxsize=1024)
def _stretch(name: str, number: int) -> tuple[Floats, Any]:
    """The state at the far end of a stretch of time, and the states within it.

    number : stretches [number, number + 1] after the epoch, [-number, -number - 1] before it, -1 being the first
    """
    from scipy.integrate import solve_ivp

    forward = number >= 0
    first = number == 0 or number == -1
    start = number * STRETCH if forward else (number + 1) * STRETCH
    end = start + STRETCH if forward else start - STRETCH
    state = ELEMENTS[name].state() if first else _stretch(name, number - 1 if forward else number + 1)[0]
    epoch = ELEMENTS[name].epoch
    solved = solve_ivp(
        lambda days, y: _derivative(epoch, days, y),
        (start, end),
        state,
        "DOP853",
        rtol=1e-11,
        atol=1e-12,
        dense_output=True,
    )
    return solved.y[:, -1], solved.sol


def _derivative(epoch: float, days: float, state: Floats) -> Floats:
    """(6,) heliocentric velocity, au/day, and acceleration, au/day^2, of body and Sun among the planets."""
    import erfa

    place = state[:3]
    planets = erfa.plan94(epoch, days, np.arange(1, 9))["p"]
    towards = planets - place
    pull = towards / (towards**2).sum(1, keepdims=True) ** 1.5 - planets / (planets**2).sum(1, keepdims=True) ** 1.5
    acceleration = -place / (place @ place) ** 1.5 + (pull / MASSES[:, None]).sum(0)
    return np.concatenate([state[3:], GAUSS**2 * acceleration])
