"""Time, the Sun and the bodies' orientation: where the Sun stands over a place at a UTC time, offline.

Positions come from astropy's built-in ephemeris (ERFA), orientations from the report of the IAU Working Group on
Cartographic Coordinates and Rotational Elements (Archinal et al. 2018, Celest. Mech. Dyn. Astr. 130:22). For the Moon
that frame agrees with the DE421 mean-Earth frame within 155 m on the ground, which is 0.005 deg.

Where the environment variable ``LUNARGR_SPICE_KERNELS`` names SPICE kernels (a meta-kernel, or several files joined
by the path separator), spiceypy answers instead, for every body that the kernels hold.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.errors import ConfigError, GeometryError, InputError
from stages.physics.bodies import Body

if TYPE_CHECKING:
    from astropy.time import Time

KERNELS_VARIABLE = "LUNARGR_SPICE_KERNELS"
AU = 149597870700.0  # m, IAU 2012 definition
SPEED_OF_LIGHT = 299792458.0  # m/s
J2000 = 2451545.0  # Julian date, TDB
CENTURY = 36525.0  # days


class SubsolarPoint(NamedTuple):
    """The point under the Sun: east longitude -180..180 and ocentric latitude, degrees; distance to the Sun, au."""

    longitude_deg: float
    latitude_deg: float
    distance_au: float


# --- time -----------------------------------------------------------------------------------------------------------

_CALENDAR = re.compile(r"^(\d{4})-(\d{2})-(\d{2})(?:[T ](\d{1,2}):(\d{2})(?::(\d{2}(?:\.\d*)?))?)?$")
_DAY_OF_YEAR = re.compile(r"^(\d{4})-(\d{3})(?:[T ](\d{1,2}):(\d{2})(?::(\d{2}(?:\.\d*)?))?)?$")


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
        return Time(time_utc, scale="utc")
    text = str(time_utc).strip().strip('"')
    bare = re.sub(r"(?:Z|\s*UTC|\+00:?00)$", "", text)
    if match := _CALENDAR.match(bare):
        year, month, day, hour, minute, second = match.groups()
        value, form = f"{year}-{month}-{day}T{hour or '00'}:{minute or '00'}:{second or '00'}", "isot"
    elif match := _DAY_OF_YEAR.match(bare):
        year, day, hour, minute, second = match.groups()
        value, form = f"{year}:{day}:{hour or '00'}:{minute or '00'}:{second or '00'}", "yday"
    else:
        raise InputError(f"{where}: expected a UTC time such as 2010-11-09T13:06:40.356, found '{text}'.")
    try:
        return Time(value.rstrip("."), format=form, scale="utc")
    except ValueError:
        raise InputError(f"{where}: expected a UTC time that exists, found '{text}'.") from None


def utc_to_et(time_utc: str | datetime) -> float:
    """Ephemeris time (seconds of TDB since J2000), which ISDs and SPICE count in."""
    time = parse_utc(time_utc).tdb
    return float(((time.jd1 - J2000) + time.jd2) * 86400.0)


def et_to_utc(ephemeris_time: float) -> str:
    """The UTC time, ISO 8601 with milliseconds and ``Z``, of seconds of TDB since J2000."""
    from astropy.time import Time

    return str(Time(J2000, ephemeris_time / 86400.0, format="jd", scale="tdb").utc.isot) + "Z"


# --- orientation ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Orientation:
    """A body's pole and prime meridian: right ascension, declination, W in degrees.

    Each of ``pole_ra`` and ``pole_dec`` is (constant, per century), ``meridian`` (constant, per day, per day^2).
    Each term is (phase, rate, d_ra, d_dec, d_w): ra += d_ra sin(a), dec += d_dec cos(a), w += d_w sin(a)
    with a = phase + rate * time, time in days, or in centuries where ``terms_per_century``.
    """

    pole_ra: tuple[float, float]
    pole_dec: tuple[float, float]
    meridian: tuple[float, float, float]
    terms: tuple[tuple[float, float, float, float, float], ...] = ()
    terms_per_century: bool = False

    def rotation(self, days: float) -> NDArray[np.float64]:
        """(3, 3), takes ICRF vectors to body-fixed ones; ``days`` of TDB since J2000."""
        centuries = days / CENTURY
        ra = self.pole_ra[0] + self.pole_ra[1] * centuries
        dec = self.pole_dec[0] + self.pole_dec[1] * centuries
        w = self.meridian[0] + (self.meridian[1] * days) % 360.0 + self.meridian[2] * days * days
        for phase, rate, d_ra, d_dec, d_w in self.terms:
            angle = math.radians((phase + rate * (centuries if self.terms_per_century else days)) % 360.0)
            ra += d_ra * math.sin(angle)
            dec += d_dec * math.cos(angle)
            w += d_w * math.sin(angle)
        return _about_z(w) @ _about_x(90.0 - dec) @ _about_z(90.0 + ra)


def _about_z(angle_deg: float) -> NDArray[np.float64]:
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle_deg: float) -> NDArray[np.float64]:
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


# Archinal et al. (2018), tables 1 and 2.
ORIENTATIONS = {
    "moon": Orientation(
        (269.9949, 0.0031),
        (66.5392, 0.0130),
        (38.3213, 13.17635815, -1.4e-12),
        (
            (125.045, -0.0529921, -3.8787, 1.5419, 3.5610),
            (250.089, -0.1059842, -0.1204, 0.0239, 0.1208),
            (260.008, 13.0120009, 0.0700, -0.0278, -0.0642),
            (176.625, 13.3407154, -0.0172, 0.0068, 0.0158),
            (357.529, 0.9856003, 0.0, 0.0, 0.0252),
            (311.589, 26.4057084, 0.0072, -0.0029, -0.0066),
            (134.963, 13.0649930, 0.0, 0.0009, -0.0047),
            (276.617, 0.3287146, 0.0, 0.0, -0.0046),
            (34.226, 1.7484877, 0.0, 0.0, 0.0028),
            (15.134, -0.1589763, -0.0052, 0.0008, 0.0052),
            (119.743, 0.0036096, 0.0, 0.0, 0.0040),
            (239.961, 0.1643573, 0.0, 0.0, 0.0019),
            (25.053, 12.9590088, 0.0043, -0.0009, -0.0044),
        ),
    ),
    "mercury": Orientation(
        (281.0103, -0.0328),
        (61.4155, -0.0049),
        (329.5988, 6.1385108, 0.0),
        (
            (174.7910857, 4.092335, 0.0, 0.0, 0.01067257),
            (349.5821714, 8.184670, 0.0, 0.0, -0.00112309),
            (164.3732571, 12.277005, 0.0, 0.0, -0.00011040),
            (339.1643429, 16.369340, 0.0, 0.0, -0.00002539),
            (153.9554286, 20.461675, 0.0, 0.0, -0.00000571),
        ),
    ),
    "venus": Orientation((272.76, 0.0), (67.16, 0.0), (160.20, -1.4813688, 0.0)),
    "mars": Orientation(
        (317.269202, -0.10927547),
        (54.432516, -0.05827105),
        (176.049863, 350.891982443297, 0.0),
        (
            (198.991226, 19139.4819985, 0.000068, 0.0, 0.0),
            (226.292679, 38280.8511281, 0.000238, 0.0, 0.0),
            (249.663391, 57420.7251593, 0.000052, 0.0, 0.0),
            (266.183510, 76560.6367950, 0.000009, 0.0, 0.0),
            (79.398797, 0.5042615, 0.419057, 0.0, 0.0),
            (122.433576, 19139.9407476, 0.0, 0.000051, 0.0),
            (43.058401, 38280.8753272, 0.0, 0.000141, 0.0),
            (57.663379, 57420.7517205, 0.0, 0.000031, 0.0),
            (79.476401, 76560.6495004, 0.0, 0.000005, 0.0),
            (166.325722, 0.5042615, 0.0, 1.591274, 0.0),
            (129.071773, 19140.0328244, 0.0, 0.0, 0.000145),
            (36.352167, 38281.0473591, 0.0, 0.0, 0.000157),
            (56.668646, 57420.9295360, 0.0, 0.0, 0.000040),
            (67.364003, 76560.2552215, 0.0, 0.0, 0.000001),
            (104.792680, 95700.4387578, 0.0, 0.0, 0.000001),
            (95.391654, 0.5042615, 0.0, 0.0, 0.584542),
        ),
        terms_per_century=True,
    ),
}


def body_name(body: str | Body) -> str:
    return (body.name if isinstance(body, Body) else str(body)).strip().lower()


def body_rotation(time_utc: str | datetime, body: str | Body = "moon") -> NDArray[np.float64]:
    """(3, 3), takes ICRF vectors to body-fixed ones at that time. Raises GeometryError for a body without a model."""
    name = body_name(body)
    if name not in ORIENTATIONS:
        raise _unknown(name)
    time = parse_utc(time_utc).tdb
    return ORIENTATIONS[name].rotation(float((time.jd1 - J2000) + time.jd2))


# --- the Sun --------------------------------------------------------------------------------------------------------


def subsolar_point(time_utc: str | datetime, body: str | Body = "moon") -> SubsolarPoint:
    """Where the Sun is overhead on ``body`` at that UTC time; good to 0.01 deg.

    The Sun's direction is the apparent one (light time and aberration), which is where its light comes from.
    Raises InputError for a time that cannot be read, GeometryError for a body that neither the built-in ephemeris nor
    the kernels of ``LUNARGR_SPICE_KERNELS`` know.
    """
    return _subsolar_point(str(time_utc), body_name(body), os.environ.get(KERNELS_VARIABLE, ""))


@lru_cache(maxsize=4096)
def _subsolar_point(time_utc: str, body: str, kernels: str) -> SubsolarPoint:
    sun = _sun_from_kernels(time_utc, body, kernels) if kernels else _sun_from_astropy(time_utc, body)
    distance = float(np.linalg.norm(sun))
    longitude = math.degrees(math.atan2(sun[1], sun[0]))
    latitude = math.degrees(math.asin(sun[2] / distance))
    return SubsolarPoint(longitude, latitude, distance / AU)


def _sun_from_astropy(time_utc: str, body: str) -> NDArray[np.float64]:
    """The Sun's apparent place, body-fixed, m."""
    if body not in ORIENTATIONS:
        raise _unknown(body)
    from astropy.coordinates import get_body_barycentric_posvel

    time = parse_utc(time_utc).tdb

    def state(name: str, at: Time) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        position, velocity = get_body_barycentric_posvel(name, at, ephemeris="builtin")
        return position.xyz.to_value("m"), velocity.xyz.to_value("m/s")

    place, velocity = state(body, time)
    sun = state("sun", time)[0] - place
    light_time = np.linalg.norm(sun) / SPEED_OF_LIGHT
    from astropy.time import TimeDelta

    sun = state("sun", time - TimeDelta(light_time, format="sec"))[0] - place
    distance = np.linalg.norm(sun)
    apparent = sun / distance + velocity / SPEED_OF_LIGHT  # aberration to first order: 20 arcsec at most here
    apparent *= distance / np.linalg.norm(apparent)
    return ORIENTATIONS[body].rotation(float((time.jd1 - J2000) + time.jd2)) @ apparent


def _sun_from_kernels(time_utc: str, body: str, kernels: str) -> NDArray[np.float64]:
    """As above, from the user's SPICE kernels; the mean-Earth frame of the Moon where they define it."""
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
        position, _ = spiceypy.spkpos("SUN", utc_to_et(time_utc), frame, "LT+S", body.upper())
    except spiceypy.exceptions.SpiceyError as error:
        reason = " ".join(str(getattr(error, "long", "") or getattr(error, "short", "") or error).split())
        raise InputError(
            f"{KERNELS_VARIABLE}: no place of the Sun seen from '{body}' at {time_utc}: {reason}"
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


def _unknown(name: str) -> GeometryError:
    return GeometryError(
        f"body '{name}': the built-in ephemeris knows {', '.join(ORIENTATIONS)}; give the sub-solar point, "
        f"or SPICE kernels in the environment variable {KERNELS_VARIABLE} (with 'lunargr[spice]')."
    )
