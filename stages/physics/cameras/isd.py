"""The common parts of frame, push-frame and line-scan ISDs: the detector with its optics, and the tables over time.

An ISD (image support data) is the JSON that ALE writes and CSM cameras read. Focal-plane lengths are in mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from schemas.errors import GeometryError
from stages.common.arrays import Floats
from stages.physics.cameras import document as read
from stages.physics.cameras.base import meet_ellipsoid
from stages.physics.cameras.distortion import distort, distort_arrays, read_distortion, undistort_arrays
from stages.physics.cameras.tables import (
    EvenTable,
    Rotations,
    States,
    check_times,
    even_pointing,
    even_positions,
    read_rotations,
    read_states,
)


@dataclass(frozen=True)
class Detector:
    """From image pixels to the directions behind the lens.

    to_line, to_sample : (3,), detector px = c0 + c1 x + c2 y of focal-plane mm, about ``centre`` = (line, sample)
    start, summing : (line, sample) of the image's first pixel on the detector, and detector px per image px
    """

    focal_length: float
    to_line: Floats
    to_sample: Floats
    centre: tuple[float, float]
    start: tuple[float, float]
    summing: tuple[float, float]
    distortion: int
    coefficients: Floats
    sense: float = 1.0  # -1: the optical axis points out of the back of the camera, see :meth:`facing`

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Detector:
        focal_length = read.number(document, "focal_length_model.focal_length", where)
        to_line = read.array(document, "focal2pixel_lines", where, (3,))
        to_sample = read.array(document, "focal2pixel_samples", where, (3,))
        determinant = to_line[1] * to_sample[2] - to_line[2] * to_sample[1]
        if not determinant or not focal_length:
            raise GeometryError(
                f"{where}: expected 'focal2pixel_lines' and 'focal2pixel_samples' that span the detector and a focal "
                f"length other than 0, found determinant {determinant:g} and {focal_length:g} mm; correct the ISD."
            )
        summing = _pair(document, "detector_line_summing", "detector_sample_summing", where)
        if min(summing) <= 0:
            raise GeometryError(f"{where}: expected detector summing above 0, found {summing}; correct the ISD.")
        code, coefficients = read_distortion(document, where)
        return cls(
            focal_length=focal_length,
            to_line=to_line,
            to_sample=to_sample,
            centre=_pair(document, "detector_center.line", "detector_center.sample", where),
            start=_pair(document, "starting_detector_line", "starting_detector_sample", where),
            summing=summing,
            distortion=code,
            coefficients=coefficients,
        )

    def directions(self, line: ArrayLike, sample: ArrayLike) -> Floats:
        """(..., 3) camera vectors, unit, of image coordinates; a line-scan camera has line 0 only."""
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        down = line * self.summing[0] + self.start[0] - self.centre[0] - self.to_line[0]
        right = sample * self.summing[1] + self.start[1] - self.centre[1] - self.to_sample[0]
        (a, b), (c, d) = self.to_line[1:], self.to_sample[1:]
        determinant = a * d - b * c
        x, y = undistort_arrays(
            self.distortion,
            self.coefficients,
            (d * down - b * right) / determinant,
            (a * right - c * down) / determinant,
        )
        vectors = np.stack([x, y, np.full_like(x, self.focal_length)], axis=-1)
        return vectors * (self.sense / np.linalg.norm(vectors, axis=-1, keepdims=True))

    def facing(self, origin: Floats, axis: Floats, radius: float) -> Detector:
        """The detector turned towards the body, where the ISD's axis (3,) points straight away from it.

        CSM cameras take the nearer of the two places where a line of sight meets the body, before or behind the camera;
        ISDs exist that rely on it.
        """
        behind, ahead = (meet_ellipsoid(origin, sign * axis, radius, radius)[1] for sign in (-1.0, 1.0))
        return replace(self, sense=-self.sense) if behind and not ahead else self

    def places(self, vectors: Floats) -> tuple[Floats, Floats]:
        """(line, sample) in the image of camera vectors (..., 3); NaN behind the camera."""
        x, y, z = np.moveaxis(vectors, -1, 0)
        scale = self.focal_length / np.where(z * self.focal_length * self.sense > 0, z, np.nan)
        dx, dy = distort_arrays(self.distortion, self.coefficients, x * scale, y * scale)
        line = self.to_line[0] + self.to_line[1] * dx + self.to_line[2] * dy + self.centre[0] - self.start[0]
        sample = self.to_sample[0] + self.to_sample[1] * dx + self.to_sample[2] * dy + self.centre[1] - self.start[1]
        return line / self.summing[0], sample / self.summing[1]

    @property
    def optics(self) -> Optics:
        """The same for numba kernels."""
        offset = self.centre[0] - self.start[0], self.centre[1] - self.start[1]
        axes = (self.to_line, self.to_sample)
        return Optics(self.focal_length, self.sense, *axes, *offset, *self.summing, self.distortion, self.coefficients)


class Optics(NamedTuple):
    """A :class:`Detector` as numba kernels take it; offsets : px from the image's first pixel to the detector's centre"""

    focal_length: float
    sense: float
    to_line: Floats
    to_sample: Floats
    line_offset: float
    sample_offset: float
    line_summing: float
    sample_summing: float
    distortion: int
    coefficients: Floats


@numba.njit(cache=True)
def detector_place(x, y, z, optics):
    """Detector (line, sample) from the detector's centre of a camera vector; NaN behind the camera."""
    if z * optics.focal_length * optics.sense <= 0:
        return math.nan, math.nan
    scale = optics.focal_length / z
    dx, dy = distort(optics.distortion, optics.coefficients, x * scale, y * scale)
    to_line, to_sample = optics.to_line, optics.to_sample
    return (
        to_line[0] + to_line[1] * dx + to_line[2] * dy,
        to_sample[0] + to_sample[1] * dx + to_sample[2] * dy,
    )


@dataclass(frozen=True)
class Exposure:
    """All of an ISD but the detector; times in s from ``centre_time`` (TDB since J2000)."""

    lines: int
    samples: int
    semi_axes: tuple[float, float]
    centre_time: float
    positions: States
    pointing: Rotations
    body: Rotations
    sun: States

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Exposure:
        major, minor = _pair(document, "radii.semimajor", "radii.semiminor", where)
        metres = 1000.0 if str(document["radii"].get("unit", "km")).lower() == "km" else 1.0
        axes = major * metres, minor * metres
        if min(axes) <= 0:
            raise GeometryError(f"{where}: expected radii above 0, found {axes} m; correct the ISD.")
        centre = read.number(document, "center_ephemeris_time", where)
        return cls(
            lines=read.size(document, "image_lines", where),
            samples=read.size(document, "image_samples", where),
            semi_axes=axes,
            centre_time=centre,
            positions=read_states(document, "instrument_position", where, centre),
            pointing=read_rotations(document, "instrument_pointing", where, centre),
            body=read_rotations(document, "body_rotation", where, centre),
            sun=read_states(document, "sun_position", where, centre),
        )

    def check_covers(self, first: float, last: float, where: str) -> None:
        """Refuse tables that do not reach from the image's first to its last time, s. Raises InputError."""
        for key, table in (
            ("instrument_position", self.positions.times),
            ("instrument_pointing", self.pointing.times),
            ("body_rotation", self.body.times),
        ):
            check_times(where, key, table, first, last)

    def even_tables(self) -> tuple[EvenTable, EvenTable, EvenTable]:
        """Camera positions, m, pointing (quaternions, camera to body-fixed) and Sun positions, m, body-fixed."""
        positions, sun = (
            even_positions(states, self.positions.times, self.body) for states in (self.positions, self.sun)
        )
        return positions, even_pointing(self.pointing, self.body), sun


def _pair(document: Mapping[str, Any], first: str, second: str, where: str) -> tuple[float, float]:
    return read.number(document, first, where), read.number(document, second, where)
