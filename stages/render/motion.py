"""Cameras that move while they take a picture: motion blur over the exposure, and lines that are read one after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from stages.common.arrays import Floats
from stages.physics.cameras.base import Camera
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.detector import Sensor

STEP_PX = 0.5  # between the moments of an exposure
FEWEST_MOMENTS, MOST_MOMENTS = 6, 64
STILL_PX = 0.1  # motion over an exposure that no pixel shows


@dataclass(frozen=True, eq=False)
class Moving(Pinhole):
    """A pinhole whose pose is that of the middle line at mid-exposure; about it place and attitude change evenly.

    velocity : (3,) m/s, body-fixed; spin : (3,) rad/s, body-fixed axis times rate
    line_time : s from the middle of one line's exposure to that of the next; exposure : s
    """

    velocity: Floats = field(default_factory=lambda: np.zeros(3))
    spin: Floats = field(default_factory=lambda: np.zeros(3))
    line_time: float = 0.0
    exposure: float = 0.0

    def at(self, time: float) -> Moving:
        """The same camera with its pose ``time`` s later."""
        rotation = turned(self.rotation.T, self.spin * time).T
        return replace(self, centre=self.centre + self.velocity * time, rotation=rotation)

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        """(..., 3) each, those of every line while it was taken."""
        origins, directions = super().rays(line, sample)
        if self.line_time == 0:
            return origins, directions
        time = (np.broadcast_to(line, directions.shape[:-1])[..., None] - self.lines / 2) * self.line_time
        return origins + self.velocity * time, turned(directions, self.spin * time)

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """(...,) each: where the line that is taken meanwhile sees the points (..., 3), by iteration."""
        points = np.asarray(points, float)
        line, sample = super().ground_to_image(points)
        for _ in range(8 if self.line_time else 0):
            time = (np.asarray(line)[..., None] - self.lines / 2) * self.line_time
            then = self.centre + turned(points - self.velocity * time - self.centre, -self.spin * time)
            line, sample = super().ground_to_image(then)
        return line, sample


def turned(vectors: Floats, angles: Floats) -> Floats:
    """(..., 3) vectors turned about axes by angles, (..., 3) rad (Rodrigues' formula)."""
    angle = np.linalg.norm(angles, axis=-1, keepdims=True)
    axis = angles / np.where(angle > 0, angle, 1.0)
    along = (axis * vectors).sum(-1, keepdims=True)
    return vectors * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle) + axis * along * (1 - np.cos(angle))


def rates(earlier: Pinhole, later: Pinhole, seconds: float) -> tuple[Floats, Floats]:
    """(3,) m/s and (3,) rad/s, body-fixed, that lead from one pose to another in a time."""
    import cv2

    turn = cv2.Rodrigues(later.rotation @ earlier.rotation.T)[0].ravel()
    return (later.centre - earlier.centre) / seconds, np.asarray(turn / seconds, float)


def set_in_motion(camera: Pinhole, velocity: Floats, spin: Floats, sensor: Sensor) -> Pinhole:
    """The camera as a sensor sees with it; itself where the sensor takes all lines at once and in no time.

    velocity, spin : (3,) m/s and rad/s, body-fixed
    """
    exposure = sensor.exposure_s or 0.0
    if exposure == 0 and sensor.line_time_s == 0:
        return camera
    still = {f.name: getattr(camera, f.name) for f in fields(Pinhole)}
    return Moving(**still, velocity=velocity, spin=spin, line_time=sensor.line_time_s, exposure=exposure)


def over_exposure(camera: Camera) -> Sequence[Camera]:
    """The camera as the exposure begins and ends; itself where it does not move meanwhile."""
    if not isinstance(camera, Moving) or camera.exposure == 0:
        return [camera]
    return [camera.at(-camera.exposure / 2), camera.at(camera.exposure / 2)]


def moments(camera: Camera, distance: float) -> Sequence[Camera]:
    """The camera at evenly spread moments of its exposure, so many that the image moves by half a pixel, or less, between two.

    distance : to the ground, m
    """
    ends = over_exposure(camera)
    if len(ends) == 1 or not isinstance(camera, Moving):
        return ends
    line, sample = (v.ravel() for v in np.meshgrid([0, camera.lines / 2, camera.lines], [0, camera.samples]))
    origins, directions = camera.rays(line, sample)
    places = [np.stack(end.ground_to_image(origins + distance * directions)) for end in ends]
    length = float(np.nanmax(np.linalg.norm(places[1] - places[0], axis=0), initial=0.0))
    if length < STILL_PX:
        return [camera]
    count = min(MOST_MOMENTS, max(FEWEST_MOMENTS, math.ceil(length / STEP_PX)))
    return [camera.at(camera.exposure * ((k + 0.5) / count - 0.5)) for k in range(count)]
