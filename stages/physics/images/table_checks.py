"""Checks of an image table against the ephemeris at its times, and against where an orbiter can be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from schemas.errors import GeometryError, InputError, LunargrError
from stages.physics.bodies.ephemeris import SubsolarPoint, subsolar_point
from stages.physics.bodies.spheres import Body
from stages.physics.images.table import Frame
from stages.physics.maps.grid import Grid, unit_vectors

SUN_TOLERANCE_DEG = 0.5  # the Moon turns by that in an hour; rounding in published tables is far below
DISTANCE_TOLERANCE = 0.005  # of the Sun's distance
LOWEST_ALTITUDE = 0.001  # of the radius: on the Moon 1.7 km, where the highest ground reaches 10 km
LARGE_BODY = 1e6  # m: about smaller ones, spacecraft do fly a radius high
LOW_ORBIT = 0.15  # of the radius
MOST_EMISSION_DEG = 80.0  # a map-projected image seen more obliquely shows next to nothing of its ground
TRUST = "mend the table, or add `trust_table` where it is right"


def check_table(table: Path, frames: Sequence[Frame], body: Body) -> list[str]:
    """Compare Suns and altitudes with the ephemeris and the body; returns what is only unusual, as sentences.

    Raises InputError for a Sun that is not that of its time, and for an altitude below the ground's relief. Images
    without a time, and bodies without ephemeris, have no Sun to compare with.
    """
    wheres = [f"{table}: image {k} ({frame.image_id})" for k, frame in enumerate(frames, start=1)]
    expected = [_expected_sun(frame, body) for frame in frames]
    for where, frame, sun in zip(wheres, frames, expected, strict=True):
        if sun is not None:
            _check_sun(where, frame, sun, _owner(frame, frames, expected))
    unusual = []
    for where, frame in zip(wheres, frames, strict=True):
        if frame.camera is not None:
            continue  # the camera model has its own position
        altitude = frame.spacecraft_altitude_m
        if altitude < LOWEST_ALTITUDE * body.radius:
            raise InputError(
                f"{where}: expected spacecraft_altitude_m of at least {LOWEST_ALTITUDE * body.radius:.0f} m, found {altitude:g} "
                f"(in kilometres?); {TRUST}."
            )
        if body.radius > LARGE_BODY and 1.0 <= altitude / body.radius < 1.0 + LOW_ORBIT:
            unusual.append(
                f"{where}: spacecraft_altitude_m {altitude:g} counts from the sphere; from the body's centre it would be an "
                f"orbit {altitude - body.radius:.0f} m high"
            )
    return unusual


def check_distinct(frames: Sequence[Frame]) -> None:
    """Refuse two images that are one band of one file, by its SHA-256: their pairs would count twice. Raises InputError."""
    seen: dict[tuple[str, int], Frame] = {}
    for frame in frames:
        first = seen.setdefault((frame.sha256, frame.band or 1), frame)
        if frame.sha256 and first is not frame:
            raise InputError(
                f"{frame.path}: image '{frame.image_id}' is the photograph of '{first.image_id}' again (same SHA-256); "
                "keep one of them in the table."
            )


def check_emission(frame: Frame, grid: Grid, row: float, col: float) -> None:
    """Refuse a map-projected image that its spacecraft saw at a grazing angle at (row, col). Raises GeometryError."""
    emission = _emission_deg(grid, row, col, frame.camera_position(grid.radius))
    if frame.camera is not None or emission <= MOST_EMISSION_DEG:
        return
    lon, lat = frame.spacecraft_longitude_deg, frame.spacecraft_latitude_deg
    exchanged = unit_vectors(lat, lon) * (grid.radius + frame.spacecraft_altitude_m)
    hint = ""
    if abs(lon) <= 90 and _emission_deg(grid, row, col, exchanged) <= MOST_EMISSION_DEG:
        hint = "; longitude and latitude look exchanged"
    raise GeometryError(
        f"image '{frame.image_id}': expected a spacecraft that sees the image's centre at up to {MOST_EMISSION_DEG:g} deg from "
        f"its zenith, found {emission:.1f} deg from {lon:g} E, {lat:g} N, {frame.spacecraft_altitude_m:g} m high{hint}; {TRUST}."
    )


def _emission_deg(grid: Grid, row: float, col: float, camera: np.ndarray) -> float:
    up = grid.local_frames(row, col).up[0]
    towards = camera - grid.radius * up
    return math.degrees(math.acos(np.clip(up @ towards / np.linalg.norm(towards), -1, 1)))


def _expected_sun(frame: Frame, body: Body) -> SubsolarPoint | None:
    """The Sun at the image's time; None without a time, or where no ephemeris knows it."""
    try:
        return subsolar_point(frame.start_time, body) if frame.start_time else None
    except LunargrError:
        return None


def _away_deg(longitude_deg: float, latitude_deg: float, sun: SubsolarPoint) -> float:
    cosine = unit_vectors(longitude_deg, latitude_deg) @ unit_vectors(sun.longitude_deg, sun.latitude_deg)
    return math.degrees(math.acos(np.clip(cosine, -1, 1)))


def _owner(frame: Frame, frames: Sequence[Frame], expected: Sequence[SubsolarPoint | None]) -> str:
    """The other image whose time has this image's Sun, '' where there is none."""
    place = frame.subsolar_longitude_deg, frame.subsolar_latitude_deg
    found = (f.image_id for f, s in zip(frames, expected, strict=True) if s and _away_deg(*place, s) < 0.05)
    return next((name for name in found if name != frame.image_id), "")


def _check_sun(where: str, frame: Frame, sun: SubsolarPoint, owner: str) -> None:
    """Raises InputError. owner : the image whose Sun it seems to be"""
    lon, lat = frame.subsolar_longitude_deg, frame.subsolar_latitude_deg
    away = _away_deg(lon, lat, sun)
    if away > SUN_TOLERANCE_DEG:
        raise InputError(
            f"{where}: expected the Sun of start_time {frame.start_time} over {sun.longitude_deg:.2f} E, {sun.latitude_deg:.2f} N, "
            f"found {lon:g} E, {lat:g} N, {away:.1f} deg away{_guess(lon, lat, sun, owner)}; {TRUST}."
        )
    if abs(frame.solar_distance_au / sun.distance_au - 1) > DISTANCE_TOLERANCE:
        raise InputError(
            f"{where}: expected solar_distance_au {sun.distance_au:.4f} at start_time {frame.start_time}, found "
            f"{frame.solar_distance_au:g}; {TRUST}."
        )


def _guess(lon: float, lat: float, sun: SubsolarPoint, owner: str) -> str:
    """What a wrong sub-solar point looks like, '' where nothing is known."""
    places = {
        "longitude and latitude look exchanged": (lat, lon),
        "they look like radians": (math.degrees(lon), math.degrees(lat)),
        "the longitude looks counted to the west": (-lon, lat),
    }
    for words, (longitude_deg, latitude_deg) in places.items():
        if abs(latitude_deg) <= 90 and _away_deg(longitude_deg, latitude_deg, sun) <= SUN_TOLERANCE_DEG:
            return f"; {words}"
    return f"; it is the Sun of image '{owner}'" if owner else ""
