"""Synthetic views: a camera's place and attitude from what a person knows (a place, a target, a field of view)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from schemas.errors import GeometryError
from stages.common.arrays import Floats
from stages.physics.cameras.base import Camera
from stages.physics.cameras.document import quaternion_matrix
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.maps.grid import unit_vectors

NEAR_NADIR = math.radians(1.0)  # closer to straight down than this, "up in the image" means north


def place(longitude_deg: float, latitude_deg: float, altitude: float, radius: float) -> Floats:
    """(3,) body-fixed, m; altitude in metres above the reference sphere. Raises GeometryError."""
    if not -90.0 <= latitude_deg <= 90.0 or not -360.0 <= longitude_deg <= 360.0:
        raise GeometryError(
            f"expected a longitude in -360..360 and a latitude in -90..90 deg, found {longitude_deg:g}, {latitude_deg:g}; correct it."
        )
    return unit_vectors(longitude_deg, latitude_deg) * (radius + altitude)


def look_at(position: Floats, target: Floats, roll_deg: float = 0.0) -> Floats:
    """(3, 3) camera axes (right, down, forward) -> body-fixed of a camera at ``position`` that looks at ``target``.

    The image's top points away from the ground, or to the north where the camera looks straight down;
    ``roll_deg`` then turns the camera clockwise about its line of sight. Raises GeometryError.
    """
    forward = target - position
    distance = float(np.linalg.norm(forward))
    if distance < 1e-6:
        raise GeometryError("`look_at`: expected a place other than the camera's, found the same.")
    forward = forward / distance
    up = position / np.linalg.norm(position)
    if math.acos(min(1.0, abs(float(forward @ up)))) < NEAR_NADIR:
        up = np.array([0.0, 0.0, 1.0])
        if abs(float(forward @ up)) > 1.0 - 1e-9:  # above a pole every way is south: the 180 deg meridian is up
            up = np.array([-1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return np.stack([c * right + s * down, c * down - s * right, forward], axis=1)


def rotation_from_quaternion(quaternion: Sequence[float]) -> Floats:
    """Camera axes -> body-fixed from (w, x, y, z). Raises GeometryError unless it has unit length to 1 %."""
    q = np.asarray(quaternion, float)
    norm = float(np.linalg.norm(q)) if q.shape == (4,) else math.nan
    if not abs(norm - 1.0) < 0.01:
        raise GeometryError(
            f"`quaternion`: expected four numbers w,x,y,z of unit length, found {', '.join(f'{v:g}' for v in np.ravel(q))}."
        )
    return quaternion_matrix(q / norm)


def pinhole_view(
    position: Floats, rotation: Floats, fov_deg: float, size_px: tuple[int, int], radius: float
) -> Pinhole:
    """A distortion-free camera; ``fov_deg`` spans the image's width. Raises GeometryError.

    position : (3,) body-fixed, m; rotation : (3, 3) camera axes to body-fixed; radius : m
    """
    if not 0.0 < fov_deg < 170.0:
        raise GeometryError(
            f"`fov_deg`: expected degrees across the image's width between 0 and 170, found {fov_deg:g}; correct it."
        )
    width, height = size_px
    if not (1 <= width <= 65536 and 1 <= height <= 65536):
        raise GeometryError(f"`size_px`: expected W,H between 1 and 65536 px, found {width},{height}.")
    focal = 0.5 * width / math.tan(math.radians(0.5 * fov_deg))
    return Pinhole(
        lines=height,
        samples=width,
        focal_px=(focal, focal),
        principal_point_px=(width / 2, height / 2),
        centre=position,
        rotation=rotation,
        semi_axes=(radius, radius),
    )


def pixel_footprint(camera: Camera, distance: float) -> float:
    """How far apart neighbouring pixels' rays are at a distance along them, m, in the middle of the image."""
    line, sample = camera.lines / 2, camera.samples / 2
    origins, directions = camera.rays(np.array([line, line + 1, line]), np.array([sample, sample, sample + 1]))
    points = origins + distance * directions
    # a line-scan camera moves between lines, so both ways count
    return float(max(np.linalg.norm(points[1] - points[0]), np.linalg.norm(points[2] - points[0])))
