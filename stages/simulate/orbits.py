"""Where the Sun and the camera were: passes of a polar orbiter over one place, at times that really had that Sun."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.physics.bodies.ephemeris import SubsolarPoint, subsolar_point
from stages.simulate.recipe import Config

RADIUS = 1737400.0  # m
FIRST_DAY, LAST_DAY = "2009-07-01", "2023-12-31"
SUN_DRIFT_DEG = -12.1908  # of the sub-solar longitude a day


@dataclass(frozen=True)
class Strip:
    """The ground that one image covers: a ragged strip, in map metres from the scene's centre.

    heading_deg : of the ground track, clockwise from grid north; width across, length along it
    """

    x: float
    y: float
    heading_deg: float
    width: float
    length: float

    def along_across(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Metres along the track and across it (to the right) from the strip's centre.

        x, y : (H, W), m on the map
        """
        s, c = math.sin(math.radians(self.heading_deg)), math.cos(math.radians(self.heading_deg))
        dx, dy = x - self.x, y - self.y
        return dx * s + dy * c, dx * c - dy * s


@dataclass(frozen=True)
class Pass:
    """One image's geometry. Angles are of level ground at the scene's centre, degrees."""

    image_id: str
    start_time: str
    sun: SubsolarPoint
    spacecraft_longitude_deg: float
    spacecraft_latitude_deg: float
    spacecraft_altitude: float
    gsd: float
    strip: Strip
    incidence_deg: float
    sun_azimuth_deg: float
    emission_deg: float
    camera_azimuth_deg: float
    phase_deg: float


def plan_passes(config: Config) -> list[Pass]:
    """Draw the passes of a recipe, seeded. Raises GeometryError through the ephemeris."""
    rng = np.random.default_rng([config.seed, 3])
    n = config.images
    oblique = np.zeros(n, bool)
    oblique[rng.permutation(n)[: round(config.oblique_share * n)]] = True
    # stratified, so that a dozen images cover the range; east and west in turn
    low, high = config.incidence_deg
    low = max(low, abs(config.latitude_deg) - 1.6 + 2.5)
    incidence = low + (high - low) * (rng.permutation(n) + rng.random(n)) / n
    east = rng.permutation(n) % 2 == 0
    passes = []
    for k in range(n):
        time, sun = _time_with_sun(config, float(incidence[k]), bool(east[k]), rng)
        altitude = float(rng.uniform(*config.altitude))
        heading = float(rng.normal(0, 5)) + (180.0 if rng.random() < 0.5 else 0.0)
        if oblique[k]:
            emission = float(rng.uniform(*config.oblique_deg))
            # slews are rolls about the track, some pitched as well
            spread = 15.0 if rng.random() < 0.7 else 60.0
            azimuth = heading + (90.0 if rng.random() < 0.5 else -90.0) + float(rng.normal(0, spread))
        else:
            emission, azimuth = abs(float(rng.normal(0, 1.5))), float(rng.uniform(0, 360))
        lon, lat = _under_spacecraft(config, altitude, emission, azimuth)
        low_alt, high_alt = config.altitude
        share = (altitude - low_alt) / (high_alt - low_alt) if high_alt > low_alt else 0.5
        strip = _strip(config, heading, rng)
        inc, sun_azimuth = direction(config.longitude_deg, config.latitude_deg, sun.longitude_deg, sun.latitude_deg)
        passes.append(
            Pass(
                image_id=f"S{k + 1:04d}{'O' if oblique[k] else 'N'}",
                start_time=time,
                sun=sun,
                spacecraft_longitude_deg=lon,
                spacecraft_latitude_deg=lat,
                spacecraft_altitude=altitude,
                gsd=round(config.image_gsd[0] + share * (config.image_gsd[1] - config.image_gsd[0]), 2),
                strip=strip,
                incidence_deg=inc,
                sun_azimuth_deg=sun_azimuth,
                emission_deg=emission,
                camera_azimuth_deg=azimuth % 360.0,
                phase_deg=_phase(inc, sun_azimuth, emission, azimuth),
            )
        )
    return passes


def direction(lon: float, lat: float, sub_lon: float, sub_lat: float) -> tuple[float, float]:
    """Zenith angle and azimuth (clockwise from north), degrees, of a far source seen from (lon, lat)."""
    p, q, d = math.radians(lat), math.radians(sub_lat), math.radians(sub_lon - lon)
    up = math.sin(p) * math.sin(q) + math.cos(p) * math.cos(q) * math.cos(d)
    east = math.cos(q) * math.sin(d)
    north = math.cos(p) * math.sin(q) - math.sin(p) * math.cos(q) * math.cos(d)
    return math.degrees(math.atan2(math.hypot(east, north), up)), math.degrees(math.atan2(east, north)) % 360.0


def sub_point(lon: float, lat: float, zenith_deg: float, azimuth_deg: float) -> tuple[float, float]:
    """The point under a far source seen at that zenith angle and azimuth: inverse of :func:`direction`."""
    p, z, a = math.radians(lat), math.radians(zenith_deg), math.radians(azimuth_deg)
    sin_lat = math.sin(p) * math.cos(z) + math.cos(p) * math.sin(z) * math.cos(a)
    y, x = math.sin(a) * math.sin(z) * math.cos(p), math.cos(z) - math.sin(p) * sin_lat
    return lon + math.degrees(math.atan2(y, x)), math.degrees(math.asin(max(-1.0, min(1.0, sin_lat))))


def _time_with_sun(
    config: Config, incidence_deg: float, east: bool, rng: np.random.Generator
) -> tuple[str, SubsolarPoint]:
    """A moment at which the Sun stands at that incidence over the scene, in the east (morning) or west."""
    first, last = np.datetime64(FIRST_DAY), np.datetime64(LAST_DAY)
    moment = first.astype("datetime64[s]") + np.timedelta64(int(rng.random() * (last - first).astype(int) * 86400), "s")
    lat = math.radians(config.latitude_deg)
    for _ in range(5):
        sun = subsolar_point(f"{moment}Z")
        d = math.radians(sun.latitude_deg)
        cosine = (math.cos(math.radians(incidence_deg)) - math.sin(lat) * math.sin(d)) / (math.cos(lat) * math.cos(d))
        hour = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
        wanted = config.longitude_deg + (hour if east else -hour)
        off = (wanted - sun.longitude_deg + 180.0) % 360.0 - 180.0
        moment = moment + np.timedelta64(round(off / SUN_DRIFT_DEG * 86400), "s")
    time = f"{moment}Z"
    return time, subsolar_point(time)


def _under_spacecraft(config: Config, altitude: float, emission_deg: float, azimuth_deg: float) -> tuple[float, float]:
    e = math.radians(emission_deg)
    radius = RADIUS + config.base_elevation
    look = math.asin(radius / (RADIUS + altitude) * math.sin(e))
    return sub_point(config.longitude_deg, config.latitude_deg, math.degrees(e - look), azimuth_deg)


def _strip(config: Config, heading_deg: float, rng: np.random.Generator) -> Strip:
    edge = config.extent
    width = edge * float(rng.uniform(*config.swath))
    room = max(0.0, 1.12 * edge - width) / 2
    length = edge * float(rng.uniform(0.85, 1.3))
    slack = 0.12 * edge
    return Strip(float(rng.uniform(-room, room)), float(rng.uniform(-slack, slack)), heading_deg % 360.0, width, length)


def _phase(incidence_deg: float, sun_azimuth_deg: float, emission_deg: float, camera_azimuth_deg: float) -> float:
    i, e = math.radians(incidence_deg), math.radians(emission_deg)
    d = math.radians(sun_azimuth_deg - camera_azimuth_deg)
    cosine = math.cos(i) * math.cos(e) + math.sin(i) * math.sin(e) * math.cos(d)
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
