"""Time, the Sun and the bodies: where the Sun stands over a place at a UTC time, offline.

Planets and the Moon move by astropy's built-in ephemeris (ERFA), satellites by their planet and the face that they turn
to it, asteroids by published elements (small_bodies.py); orientations are the IAU's (orientations.py). Sub-solar points
are good to 0.01 deg for the Moon, Mercury, Venus, Earth, Mars, Ceres, Vesta, Eros and Bennu in the years of their missions,
to 0.03 deg for Jupiter's, Saturn's and Neptune's satellites (the built-in ephemeris), 0.1 deg for Pluto and Charon. For
the Moon the IAU frame agrees with the DE421 mean-Earth frame within 155 m on the ground, which is 0.005 deg.

Where the environment variable ``LUNARGR_SPICE_KERNELS`` names SPICE kernels (a meta-kernel, or several files joined
by the path separator), spiceypy answers instead, for every body that the kernels hold.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from schemas.errors import ConfigError, GeometryError, InputError
from stages.common.arrays import Floats
from stages.physics.bodies.orientations import CENTURY, ORIENTATIONS
from stages.physics.bodies.small_bodies import ELEMENTS, GAUSS, Elements, small_body_state
from stages.physics.bodies.spheres import Body

if TYPE_CHECKING:
    from astropy.time import Time

KERNELS_VARIABLE = "LUNARGR_SPICE_KERNELS"
AU = 149597870700.0  # m, IAU 2012 definition
SPEED_OF_LIGHT = 299792458.0  # m/s
J2000 = 2451545.0  # Julian date, TDB
DAY = 86400.0  # s


class SubsolarPoint(NamedTuple):
    """The point under the Sun: east longitude -180..180 and ocentric latitude, degrees; distance to the Sun, au."""

    longitude_deg: float
    latitude_deg: float
    distance_au: float


# --- time -----------------------------------------------------------------------------------------------------------

FIRST_YEAR, LAST_YEAR = 1960, 2099  # UTC begins with 1960; ERFA's positions of the Earth end with 2100
# year, month and day or day of year, hour, minute, second
_UTC = re.compile(r"^(\d{4})-(?:(\d{2})-(\d{2})|(\d{3}))(?:[T ](\d{1,2}):(\d{2})(?::(\d{2}(?:\.\d*)?))?)?$")


def parse_utc(time_utc: str | datetime, where: str = "time") -> Time:
    """A UTC time as astropy's ``Time``.

    time_utc : ``2010-11-09T13:06:40.356``, with or without ``Z``, with a day of year (``2010-313T13:06:40``),
        or a datetime (taken as UTC where it names no zone).
    Raises InputError, with ``where`` in its message.
    """
    from astropy.time import Time

    if isinstance(time_utc, datetime):
        if time_utc.tzinfo is not None:
            time_utc = time_utc.astimezone(UTC).replace(tzinfo=None)
        _check_year(time_utc.year, where)
        return Time(time_utc, scale="utc")
    text = str(time_utc).strip().strip('"')
    match = _UTC.match(re.sub(r"(?:Z|\s*UTC|\+00:?00)$", "", text))
    if match is None:
        raise InputError(f"{where}: expected a UTC time such as 2010-11-09T13:06:40.356, found '{text}'; write it so.")
    year, month, day, day_of_year, hour, minute, second = match.groups("00")
    _check_year(int(year), where)
    clock = f"{hour}:{minute}:{second}".rstrip(".")
    try:
        if match[4]:
            return Time(f"{year}:{day_of_year}:{clock}", format="yday", scale="utc")
        return Time(f"{year}-{month}-{day}T{clock}", format="isot", scale="utc")
    except ValueError:
        raise InputError(f"{where}: expected a UTC time that exists, found '{text}'; mend it.") from None


def _check_year(year: int, where: str) -> None:
    if not FIRST_YEAR <= year <= LAST_YEAR:
        raise InputError(
            f"{where}: expected a UTC time of the years {FIRST_YEAR} to {LAST_YEAR}, found {year}; mend it."
        )


def utc_to_et(time_utc: str | datetime) -> float:
    """Ephemeris time (seconds of TDB since J2000), which ISDs and SPICE count in."""
    return _days(parse_utc(time_utc).tdb) * DAY


def et_to_utc(ephemeris_time: float) -> str:
    """The UTC time, ISO 8601 with milliseconds and ``Z``, of seconds of TDB since J2000."""
    from astropy.time import Time

    return str(Time(J2000, ephemeris_time / DAY, format="jd", scale="tdb").utc.isot) + "Z"


# --- the Sun --------------------------------------------------------------------------------------------------------


def subsolar_point(time_utc: str | datetime, body: str | Body = "moon") -> SubsolarPoint:
    """The point of ``body`` over which the Sun stands at that UTC time; for its accuracy see the top of this file.

    The Sun's direction is the apparent one (light time and aberration), which is where its light comes from.
    Raises InputError for a time that cannot be read, GeometryError for a body that neither the built-in ephemeris nor
    the kernels of ``LUNARGR_SPICE_KERNELS`` know.
    """
    longitude_deg, latitude_deg, distance = place_of(_apparent_position("sun", time_utc, body))
    return SubsolarPoint(longitude_deg, latitude_deg, distance / AU)


def place_of(position: Floats) -> tuple[float, float, float]:
    """East longitude -180..180 and ocentric latitude, deg, and distance from the centre of a position (3,)."""
    distance = float(np.linalg.norm(position))
    longitude = math.degrees(math.atan2(position[1], position[0]))
    return longitude, math.degrees(math.asin(position[2] / distance)), distance


def earth_position(time_utc: str | datetime, body: str | Body = "moon") -> Floats:
    """(3,) the Earth's apparent position over ``body`` at that UTC time, body-fixed, m.

    Raises as :func:`subsolar_point` does. Over the Moon the direction is good to 0.01 deg.
    """
    return np.array(_apparent_position("earth", time_utc, body), float)


def _apparent_position(target: str, time_utc: str | datetime, body: str | Body) -> Floats:
    """(3,) of the Sun or the Earth, with light time and aberration, body-fixed, m; not to be written to."""
    name = (body.name if isinstance(body, Body) else body).strip().lower()
    kernels = os.environ.get(KERNELS_VARIABLE, "")
    return (
        _from_kernels(target, str(time_utc), name, kernels) if kernels else _from_astropy(target, str(time_utc), name)
    )


# Satellites turn one face to their planet: where that face looks is where the planet is. Mean distances, m (NASA fact
# sheets); eccentric orbits swing by a few degrees of this small offset.
SATELLITES = {
    "phobos": ("mars", 9.376e6),
    "deimos": ("mars", 23.463e6),
    "io": ("jupiter", 421.8e6),
    "europa": ("jupiter", 671.1e6),
    "ganymede": ("jupiter", 1070.4e6),
    "callisto": ("jupiter", 1882.7e6),
    "mimas": ("saturn", 185.5e6),
    "enceladus": ("saturn", 238.0e6),
    "tethys": ("saturn", 294.7e6),
    "dione": ("saturn", 377.4e6),
    "rhea": ("saturn", 527.1e6),
    "titan": ("saturn", 1221.9e6),
    "iapetus": ("saturn", 3560.9e6),
    "triton": ("neptune", 354.8e6),
}
# Mean elements of the Pluto system's centre for 1800..2050 (Standish, JPL, "Approximate positions of the planets"):
# a au, e, inclination, mean longitude, longitude of perihelion, node; and their change per century
PLUTO = (
    (39.48211675, 0.24882730, 17.14001206, 238.92903833, 224.06891629, 110.30393684),
    (-0.00031596, 0.00005170, 0.00004818, 145.20780515, -0.04062942, -0.01183482),
)


@lru_cache(maxsize=4096)
def _from_astropy(target: str, time_utc: str, body: str) -> Floats:
    from astropy.time import TimeDelta

    if body not in ORIENTATIONS:
        raise GeometryError(
            f"body '{body}': the Sun's place is known without kernels for {', '.join(sorted(ORIENTATIONS))}; give the sub-solar point, "
            f"or SPICE kernels in the environment variable {KERNELS_VARIABLE} (with 'lunargr[spice]')."
        )

    time = parse_utc(time_utc).tdb
    place, velocity = _state(body, time)
    towards = _builtin(target, time)[0] - place
    light_time = np.linalg.norm(towards) / SPEED_OF_LIGHT
    towards = _builtin(target, time - TimeDelta(light_time, format="sec"))[0] - place
    distance = np.linalg.norm(towards)
    apparent = towards / distance + velocity / SPEED_OF_LIGHT  # aberration to first order: 20 arcsec at most here
    apparent *= distance / np.linalg.norm(apparent)
    return ORIENTATIONS[body].rotation(_days(time)) @ apparent


def _state(body: str, time: Time) -> tuple[Floats, Floats]:
    """Barycentric position, m, and velocity, m/s, ICRF."""
    if body in SATELLITES:
        planet, distance = SATELLITES[body]
        place, velocity = _builtin(planet, time)
        # row 0 of the rotation is the prime meridian's direction
        offset, motion = _moving(lambda days: -distance * ORIENTATIONS[body].rotation(days)[0], _days(time), 1e-3)
        return place + offset, velocity + motion
    if body in ("pluto", "charon"):
        position, motion = _moving(lambda days: _pluto(days / CENTURY) * AU, _days(time), 10.0)
    elif body in ELEMENTS:
        position, motion = small_body_state(body, J2000 + _days(time))
        position, motion = position * AU, motion * AU / DAY
    else:
        return _builtin(body, time)
    place, velocity = _builtin("sun", time)
    return place + position, velocity + motion


def _moving(position: Callable[[float], Floats], days: float, step: float) -> tuple[Floats, Floats]:
    """(3,) position, m, and velocity, m/s, at ``days``, by central differences over ``step`` days."""
    before, now, after = (position(days + k * step) for k in (-1, 0, 1))
    return now, (after - before) / (2 * step * DAY)


def _pluto(centuries: float) -> Floats:
    """Heliocentric place of the Pluto system's centre, au, equatorial."""
    a, e, inclination, longitude, perihelion, node = (c + r * centuries for c, r in zip(*PLUTO, strict=True))
    elements = Elements(
        0.0, longitude - perihelion, perihelion - node, node, inclination, e, math.degrees(GAUSS / a**1.5), ""
    )
    return elements.state()[:3]


def _builtin(name: str, time: Time) -> tuple[Floats, Floats]:
    """Barycentric position, m, and velocity, m/s, ICRF, of the Sun, a planet or the Moon."""
    from astropy.coordinates import get_body_barycentric_posvel

    position, velocity = get_body_barycentric_posvel(name, time, ephemeris="builtin")
    return position.xyz.to_value("m"), velocity.xyz.to_value("m/s")


def _days(time: Time) -> float:
    """Days of TDB since J2000 of a time in TDB."""
    return float((time.jd1 - J2000) + time.jd2)


@lru_cache(maxsize=4096)
def _from_kernels(target: str, time_utc: str, body: str, kernels: str) -> Floats:
    """From the user's SPICE kernels; the mean-Earth frame of the Moon where they define it."""
    try:
        import spiceypy
    except ImportError:
        raise ConfigError(
            f"{KERNELS_VARIABLE}: expected spiceypy to read SPICE kernels, found none; install 'lunargr[spice]'."
        ) from None
    frames = ["MOON_ME", "IAU_MOON"] if body == "moon" else [f"IAU_{body.upper()}"]
    try:
        _furnish(kernels)
        frame = next((f for f in frames if spiceypy.namfrm(f) != 0 and _frame_has_data(f)), frames[-1])
        position, _ = spiceypy.spkpos(target.upper(), utc_to_et(time_utc), frame, "LT+S", body.upper())
    except spiceypy.exceptions.SpiceyError as error:
        reason = " ".join(str(getattr(error, "long", "") or getattr(error, "short", "") or error).split())
        raise InputError(
            f"{KERNELS_VARIABLE}: no place of the {target.title()} seen from '{body}' at {time_utc}: {reason}"
        ) from None
    return np.asarray(position) * 1000.0


def _frame_has_data(frame: str) -> bool:
    import spiceypy

    try:
        spiceypy.pxform("J2000", frame, 0.0)
    except spiceypy.exceptions.SpiceyError:
        return False
    return True


@lru_cache(maxsize=8)
def _furnish(kernels: str) -> None:
    import spiceypy

    for path in kernels.split(os.pathsep):
        if path and not os.path.exists(path):
            raise InputError(f"{KERNELS_VARIABLE}: no such file '{path}'.")
        if path:
            spiceypy.furnsh(path)
