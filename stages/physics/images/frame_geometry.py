"""Missing columns of the image table: Sun and spacecraft from camera models, times from labels and product ids."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from schemas.errors import GeometryError, InputError
from stages.physics.bodies.ephemeris import AU, et_to_utc, place_of, subsolar_point
from stages.physics.bodies.spheres import Body
from stages.physics.cameras import Camera, open_camera
from stages.physics.images.labels import label_time, product_time
from stages.physics.maps.grid import BODY_TOLERANCE, require_crs
from stages.physics.maps.rasters import open_raster

SUN_COLUMNS = ("subsolar_longitude_deg", "subsolar_latitude_deg", "solar_distance_au")
SPACECRAFT_COLUMNS = ("spacecraft_longitude_deg", "spacecraft_latitude_deg", "spacecraft_altitude_m")


def open_camera_for(path: Path, body_radius: float) -> Camera:
    """The camera in a file. Raises LunargrError, also where it is a camera at a body of another radius (m)."""
    camera = open_camera(path)
    if abs(camera.semi_axes[0] - body_radius) > BODY_TOLERANCE * body_radius:
        raise GeometryError(
            f"{path}: expected a camera at a body of {body_radius:g} m radius, found {camera.semi_axes[0]:g} m; name the body "
            "with `body`, or with the key 'body' in a pinhole camera's JSON."
        )
    return camera


def complete_row(
    row: Mapping[str, str], image: Path, camera_path: Path | None, body: Body, where: str
) -> dict[str, str]:
    """A row of the image table with its empty columns filled in as far as they can be derived.

    The Sun comes from the camera model, else from the time; the time from the row, the camera model, the image's own
    label or its LROC product id; the spacecraft from the camera model at the middle of the image. Values of the row are
    kept. Raises LunargrError for a camera model or a time that cannot be read.
    """
    full = dict(row)
    for columns in (SUN_COLUMNS[:2], SPACECRAFT_COLUMNS[:2]):
        given = [k for k in columns if full.get(k)]
        if len(given) == 1:
            raise InputError(
                f"{where}: expected both {columns[0]} and {columns[1]}, or neither, found {given[0]} alone; half a place "
                "cannot be completed from elsewhere."
            )
    lacking = [k for k in (*SUN_COLUMNS, *SPACECRAFT_COLUMNS, "start_time") if not full.get(k)]
    if not lacking:
        return full
    camera = open_camera_for(camera_path, body.radius) if camera_path is not None else None
    if not full.get("start_time"):
        try:
            full["start_time"] = _time(full.get("image_id", ""), image, camera)
        except InputError:
            if lacking != ["start_time"]:  # an unreadable label matters only where the time is needed for the Sun
                raise
            full["start_time"] = ""
    sun = _sun(camera, full["start_time"], body, where) if any(not full.get(k) for k in SUN_COLUMNS) else None
    if sun is not None:
        for key, value in zip(SUN_COLUMNS, sun, strict=True):
            full[key] = full.get(key) or repr(value)
    if camera is not None:
        for key, value in zip(SPACECRAFT_COLUMNS, _spacecraft(camera, body.radius), strict=True):
            full[key] = full.get(key) or repr(value)
    elif any(not full.get(k) for k in SPACECRAFT_COLUMNS):
        with open_raster(image, "an image") as dataset:  # a raw image lacks its camera before it lacks these
            require_crs(str(image), dataset.crs, dataset.transform, body)
    return full


def _time(image_id: str, image: Path, camera: Camera | None) -> str:
    """UTC, empty where it is not known."""
    et = None if camera is None else camera.ephemeris_time(0.0)
    if et is not None:
        return et_to_utc(float(et))
    return label_time(image) or product_time(image_id) or product_time(image.name) or ""


def _sun(camera: Camera | None, time: str, body: Body, where: str) -> tuple[float, float, float] | None:
    """Sub-solar longitude and latitude, degrees, and distance, au; None where neither camera nor time tells it."""
    position = None if camera is None else camera.sun_position(camera.lines / 2)
    if position is not None:
        longitude_deg, latitude_deg, distance = place_of(position)
        return longitude_deg, latitude_deg, distance / AU
    if not time:
        return None
    try:
        point = subsolar_point(time, body)
        return point.longitude_deg, point.latitude_deg, point.distance_au
    except GeometryError as error:
        raise GeometryError(f"{where}: {error}") from None


def _spacecraft(camera: Camera, body_radius: float) -> tuple[float, float, float]:
    """Longitude and latitude, degrees, and altitude, m, while the middle line was taken."""
    x, y, z = (float(v) for v in camera.position(camera.lines / 2))
    distance = math.sqrt(x * x + y * y + z * z)
    return math.degrees(math.atan2(y, x)), math.degrees(math.asin(z / distance)), distance - body_radius
