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

from schemas.errors import GeometryError, InputError
from stages.common.arrays import Floats
from stages.physics.cameras import document as read
from stages.physics.cameras.base import Camera
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

LEAST_FOCAL_LENGTH = 1.0  # mm: below, an ISD gives metres


@dataclass(frozen=True)
class Detector:
    """From image pixels to the directions behind the lens.

    to_line, to_sample : (3,), detector px = c0 + c1 x + c2 y of focal-plane mm, about ``centre`` = (line, sample)
    start, summing : (line, sample) of the image's first pixel on the detector, and detector px per image px
    notes : what was taken otherwise than the ISD says
    """

    focal_length: float
    to_line: Floats
    to_sample: Floats
    centre: tuple[float, float]
    start: tuple[float, float]
    summing: tuple[float, float]
    distortion: int
    coefficients: Floats
    notes: tuple[str, ...] = ()

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Detector:
        focal_length = read.number(document, "focal_length_model.focal_length", where)
        to_line = read.array(document, "focal2pixel_lines", where, (3,))
        to_sample = read.array(document, "focal2pixel_samples", where, (3,))
        determinant = to_line[1] * to_sample[2] - to_line[2] * to_sample[1]
        if not determinant or abs(focal_length) < LEAST_FOCAL_LENGTH:
            raise GeometryError(
                f"{where}: expected 'focal2pixel_lines' and 'focal2pixel_samples' that span the detector and a focal length "
                f"in mm, found determinant {determinant:g} and {focal_length:g}; is the length in metres? Correct the ISD."
            )
        summing = _pair(document, "detector_line_summing", "detector_sample_summing", where)
        if min(summing) <= 0:
            raise GeometryError(f"{where}: expected detector summing above 0, found {summing}; correct the ISD.")
        code, coefficients = read_distortion(document, where)
        centre, notes = _centre(document, where)
        return cls(
            focal_length=focal_length,
            to_line=to_line,
            to_sample=to_sample,
            centre=centre,
            start=_pair(document, "starting_detector_line", "starting_detector_sample", where),
            summing=summing,
            distortion=code,
            coefficients=coefficients,
            notes=(*notes, *document.get("lunargr_notes", ())),
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
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    def facing(self, place: Floats, z_axis: Floats) -> Detector:
        """The detector with its optical axis towards the body.

        Some cameras are defined with their z axis away from the ground (Apollo Metric, Lunar Orbiter, LORRI): they look
        along (x, y, -f), ISIS's zDirection = -1. Of an orbiter no axis more than 90 degrees from nadir meets the body.

        place : (3,) of the camera, m; z_axis : (3,) of the camera; both body-fixed
        """
        away = float(place @ z_axis) * self.focal_length > 0
        return replace(self, focal_length=-self.focal_length) if away else self

    def places(self, vectors: Floats) -> tuple[Floats, Floats]:
        """(line, sample) in the image of camera vectors (..., 3); NaN behind the camera."""
        x, y, z = np.moveaxis(vectors, -1, 0)
        scale = self.focal_length / np.where(z * self.focal_length > 0, z, np.nan)
        dx, dy = distort_arrays(self.distortion, self.coefficients, x * scale, y * scale)
        line = self.to_line[0] + self.to_line[1] * dx + self.to_line[2] * dy + self.centre[0] - self.start[0]
        sample = self.to_sample[0] + self.to_sample[1] * dx + self.to_sample[2] * dy + self.centre[1] - self.start[1]
        return line / self.summing[0], sample / self.summing[1]

    @property
    def optics(self) -> Optics:
        """The same for numba kernels."""
        offset = self.centre[0] - self.start[0], self.centre[1] - self.start[1]
        axes = (self.to_line, self.to_sample)
        return Optics(self.focal_length, *axes, *offset, *self.summing, self.distortion, self.coefficients)


class Optics(NamedTuple):
    """A :class:`Detector` as numba kernels take it; offsets : px from the image's first pixel to the detector's centre"""

    focal_length: float
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
    if z * optics.focal_length <= 0:
        return math.nan, math.nan
    scale = optics.focal_length / z
    dx, dy = distort(optics.distortion, optics.coefficients, x * scale, y * scale)
    to_line, to_sample = optics.to_line, optics.to_sample
    return (
        to_line[0] + to_line[1] * dx + to_line[2] * dy,
        to_sample[0] + to_sample[1] * dx + to_sample[2] * dy,
    )


@dataclass(frozen=True, eq=False)
class IsdCamera(Camera):
    """Base of the cameras that ISDs describe: all see through a ``detector``."""

    lines: int
    samples: int
    semi_axes: tuple[float, float]
    detector: Detector

    @property
    def notes(self) -> tuple[str, ...]:
        return self.detector.notes


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


def _centre(document: Mapping[str, Any], where: str) -> tuple[tuple[float, float], tuple[str, ...]]:
    """(line, sample) of the detector's centre, and what is to be said of it.

    ALE gives x and y of BORESIGHT, a direction, for instruments whose kernel has the centre under CCD_CENTER (line and
    sample to half a pixel, as kernels count from 0 or 1).
    """
    line, sample = _pair(document, "detector_center.line", "detector_center.sample", where)
    keywords = document.get("naif_keywords") or {}
    if not isinstance(keywords, Mapping):
        raise InputError(f"{where}: expected an object in 'naif_keywords', found {keywords!r:.40}; correct the ISD.")
    for key, boresight in keywords.items():
        centre = keywords.get(str(key).removesuffix("BORESIGHT") + "CCD_CENTER")
        if str(key).endswith("_BORESIGHT") and centre is not None and [*np.ravel(boresight)][:2] == [sample, line]:
            x, y = read.array({"CCD_CENTER": centre}, "CCD_CENTER", where, (2,)).tolist()
            note = f"{where}: 'detector_center' holds the boresight's direction; CCD_CENTER, line {y:g} and sample {x:g}, is taken"
            return (y, x), (note,)
    return (line, sample), ()


def _pair(document: Mapping[str, Any], first: str, second: str, where: str) -> tuple[float, float]:
    return read.number(document, first, where), read.number(document, second, where)
