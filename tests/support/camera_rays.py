"""Cameras set up by hand, and where their rays meet a terrain that a formula gives: an independent way to the ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.physics.cameras.base import Camera, meet_ellipsoid
from stages.physics.cameras.pinhole import Pinhole

Floats = NDArray[np.float64]


def looking_at(
    position: ArrayLike,
    target: ArrayLike,
    field_of_view: float,
    size: tuple[int, int],
    up: ArrayLike | None = None,
    radius: float = 1737400.0,
) -> Pinhole:
    """A camera at ``position`` with ``target`` in the middle of its image.

    position, target : (3,), body-fixed, m; field_of_view : rad, across the samples
    size : (samples, lines); up : (3,) what the top of the image points to (the body's north by default)
    """
    position, target = np.asarray(position, float), np.asarray(target, float)
    forward = target - position
    distance = np.linalg.norm(forward)
    forward = forward / distance
    above = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, float)
    right = np.cross(forward, above)
    if np.linalg.norm(right) < 1e-9 * np.linalg.norm(above):  # straight along "up": any other axis will do
        right = np.cross(forward, np.array([1.0, 0.0, 0.0]))
        if np.linalg.norm(right) < 1e-9:
            right = np.cross(forward, np.array([0.0, 1.0, 0.0]))
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    focal = size[0] / 2 / np.tan(field_of_view / 2)
    return Pinhole(
        lines=size[1],
        samples=size[0],
        focal_px=(focal, focal),
        principal_point_px=(size[0] / 2, size[1] / 2),
        centre=position,
        rotation=np.stack([right, down, forward], axis=1),
        semi_axes=(radius, radius),
    )


def image_to_terrain(
    camera: Camera,
    line: ArrayLike,
    sample: ArrayLike,
    height_at: Callable[[Floats, Floats], Floats],
    tolerance: float = 1e-3,
    iterations: int = 50,
) -> Floats:
    """(..., 3) body-fixed points where the rays meet a terrain; NaN where they do not, or leave it.

    height_at : (longitude, latitude in degrees) -> metres above the sphere of the equatorial radius, NaN outside
    tolerance : m, between the ray and the terrain
    Each step raises the sphere to the terrain under the last answer, with the secant's slope where two steps
    give one; over terrain steeper than the ray the answer may be the second surface that it crosses.
    """
    origin, direction = camera.rays(line, sample)
    radius = camera.semi_axes[0]
    height = np.zeros(origin.shape[:-1])
    previous_height: Floats | None = None
    previous_gap: Floats | None = None
    points = np.full_like(origin, np.nan)
    done = np.zeros(height.shape, bool)
    for _ in range(iterations):
        trial, hit = meet_ellipsoid(origin, direction, radius + height, radius + height)
        r = np.linalg.norm(trial, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            longitude = np.degrees(np.arctan2(trial[..., 1], trial[..., 0]))
            latitude = np.degrees(np.arcsin(np.clip(trial[..., 2] / r, -1, 1)))
            terrain = np.asarray(height_at(longitude, latitude), float)
            gap = np.where(hit, terrain, np.nan) - height
            found = np.abs(gap) < tolerance
            points = np.where((found & ~done)[..., None], trial, points)
            done |= found
            if (done | ~np.isfinite(gap)).all():
                break
            step = gap
            if previous_gap is not None and previous_height is not None:
                slope = (gap - previous_gap) / (height - previous_height)
                secant = -gap / slope
                usable = np.isfinite(secant) & (slope < -0.2) & (np.abs(secant) < 10 * np.abs(gap) + 1)
                step = np.where(usable, secant, 0.5 * gap)
        previous_height, previous_gap = height, gap
        height = np.where(done | ~np.isfinite(step), height, height + step)
    return points
