"""Push-frame camera from an ALE/CSM ISD (LROC WAC, THEMIS VIS, MARCI, CaSSIS, ...): an image of many narrow exposures.

Every ``interframe_delay`` seconds the detector takes a framelet of a few lines; the image is the framelets one below
the other. They overlap on the ground: of several that show a point, the one whose middle is nearest to it counts.
Conventions are those of USGSCSM's push-frame model (github.com/DOI-USGS/usgscsm), except that here ``ground_to_image``
is the inverse of ``image_to_ground`` for flipped framelets too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.errors import GeometryError, InputError
from stages.physics.cameras import document as read
from stages.physics.cameras.base import Floats, register
from stages.physics.cameras.isd import Detector, Exposure, IsdCamera, detector_place

CHUNK = 8192  # points per parallel piece
EDGE = 0.5  # lines beyond a framelet that its outermost pixels cover where the next framelet leaves a gap
STEPS = 64  # framelets tried for a point without a neighbour to start from


@register
@dataclass(frozen=True, eq=False)
class PushFrame(IsdCamera):
    """``framelets`` exposures of ``height`` lines each, in the order of the image.

    centres : (n, 3) places of the camera, body-fixed, m; rotations : (n, 3, 3), camera to body-fixed
    suns : (n, 3), body-fixed, m; times : (n,), s of TDB since J2000, the middles of the exposures
    trimmed : lines of the detector's framelet left out at its top (and as many at its bottom)
    flipped : a framelet's first image line is its last on the detector
    slope : detector lines by which the ground moves from one framelet of the image to the next
    """

    kind: ClassVar[str] = "push-frame"
    answers_to: ClassVar[tuple[str, ...]] = ("USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL",)

    height: int
    trimmed: int
    flipped: bool
    centres: Floats
    rotations: Floats
    suns: Floats
    times: Floats
    slope: float = 0.0

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> PushFrame:
        exposure = Exposure.from_document(document, where)
        detector = Detector.from_document(document, where)
        height, trimmed, framelets = _framelets(document, exposure.lines, detector.summing[0], where)
        delay = read.number(document, "interframe_delay", where)
        duration = read.number(document, "exposure_duration", where)
        if (framelets > 1 and not delay > 0) or duration < 0:
            raise InputError(
                f"{where}: expected 'interframe_delay' above 0 s and 'exposure_duration' of 0 s or more, found {delay:g} "
                f"and {duration:g}."
            )
        first = read.number(document, "starting_ephemeris_time", where) + duration / 2 - exposure.centre_time
        times = first + delay * np.arange(framelets)
        exposure.check_covers(float(times[0]), float(times[-1]), where)
        if _flag(document, "framelet_order_reversed", where):
            times = times[::-1].copy()
        positions, pointing, sun = exposure.even_tables()
        quaternions = pointing.at(times)
        quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
        camera = cls(
            lines=framelets * (height - 2 * trimmed),
            samples=exposure.samples,
            semi_axes=exposure.semi_axes,
            detector=detector,
            height=height - 2 * trimmed,
            trimmed=trimmed,
            flipped=_flag(document, "framelets_flipped", where),
            centres=positions.at(times),
            rotations=read.quaternion_matrix(quaternions),
            suns=sun.at(times),
            times=np.asarray(exposure.centre_time + times, np.float64),
        )
        k = framelets // 2
        camera = replace(camera, detector=detector.facing(camera.centres[k], camera.rotations[k, :, 2]))
        return replace(camera, slope=camera._slope(where))

    def _slope(self, where: str) -> float:
        framelets = len(self.times)
        if framelets == 1:
            return 0.0
        k = framelets // 2
        point = self.image_to_ground((k + 0.5) * self.height, self.samples / 2, missing="nearest")
        rows = [self._in_framelet(self._camera_vectors(point, np.array(i)))[0] for i in (k - 1, k)]
        slope = float(rows[1] - rows[0])
        if not abs(slope) > 1e-6:
            raise GeometryError(
                f"{where}: expected a camera that moves over the ground, found none; check its tables of position and "
                "pointing."
            )
        return slope

    def framelet(self, line: ArrayLike) -> NDArray[np.int64]:
        places = np.nan_to_num(np.asarray(line, float), nan=0.0) / self.height
        return np.clip(np.floor(places), 0, len(self.times) - 1).astype(np.int64)

    def edge_lines(self, count: int) -> Floats:
        starts = np.arange(len(self.times)) * float(self.height)
        return np.sort(np.concatenate([starts, starts + self.height - 1e-6]))

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        k = self.framelet(line)
        within = line - k * self.height
        row = (self.height - within if self.flipped else within) + self.trimmed
        camera = self.detector.directions(row, sample)
        return self.centres[k], (self.rotations[k] @ camera[..., None])[..., 0]

    def position(self, line: ArrayLike, sample: ArrayLike | None = None) -> Floats:
        return self.centres[self.framelet(line)]

    def sun_position(self, line: ArrayLike) -> Floats:
        return self.suns[self.framelet(line)]

    def ephemeris_time(self, line: ArrayLike) -> Floats:
        return self.times[self.framelet(line)]

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """As :meth:`Camera.ground_to_image`; also NaN for points between two framelets, more than half a line from both.

        points : (..., 3) body-fixed, m; returns line and sample, (...,) px each
        """
        points = np.asarray(points, float)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        line, sample = np.empty(len(flat)), np.empty(len(flat))
        strip = _Strip(self.centres, self.rotations, self.slope, float(self.height), float(self.trimmed), self.flipped)
        _find(flat, strip, self.detector.optics, line, sample)
        return line.reshape(points.shape[:-1]), sample.reshape(points.shape[:-1])

    def ground_to_framelet(self, points: ArrayLike, framelet: ArrayLike) -> tuple[Floats, Floats]:
        points = np.asarray(points, float)
        k = np.broadcast_to(np.asarray(framelet), points.shape[:-1])
        row, sample = self._in_framelet(self._camera_vectors(points, k))
        within = self.height - row if self.flipped else row
        # the outermost pixels' centres lie half a line from the edges: interpolation must not reach past them
        within = np.clip(within, min(0.5, self.height / 2), max(self.height - 0.5, self.height / 2))
        return k * self.height + within, sample

    def _camera_vectors(self, points: Floats, k: NDArray[np.int64]) -> Floats:
        return (np.swapaxes(self.rotations[k], -1, -2) @ (points - self.centres[k])[..., None])[..., 0]

    def _in_framelet(self, vectors: Floats) -> tuple[Floats, Floats]:
        """(row, sample) on the detector, rows from the first that the image keeps."""
        row, sample = self.detector.places(vectors)
        return row - self.trimmed, sample


def _framelets(document: Mapping[str, Any], lines: int, summing: float, where: str) -> tuple[int, int, int]:
    """(lines of a framelet, lines left out at its top, number of framelets), in image lines. Raises InputError."""
    height = read.size(document, "framelet_height", where) / summing
    overlap = read.number(document, "num_lines_overlap", where, default=0.0)
    if height != int(height) or lines % int(height):
        raise InputError(
            f"{where}: expected 'image_lines' to be whole framelets of 'framelet_height' / 'detector_line_summing' = "
            f"{height:g} lines, found {lines}."
        )
    if overlap < 0 or overlap % 2 or overlap >= height:
        raise InputError(
            f"{where}: expected an even number of lines from 0 to less than the framelet's {height:g} in "
            f"'num_lines_overlap', found {overlap:g}."
        )
    return int(height), int(overlap) // 2, lines // int(height)


def _flag(document: Mapping[str, Any], key: str, where: str) -> bool:
    found = read.value(document, key, where)
    if not isinstance(found, bool):
        raise InputError(f"{where}: expected true or false in '{key}', found {found!r:.40}; correct the ISD.")
    return found


class _Strip(NamedTuple):
    """The framelets of a :class:`PushFrame` as numba kernels take them."""

    centres: Floats
    rotations: Floats
    slope: float
    height: float
    trimmed: float
    flipped: bool


@numba.njit(cache=True)
def _place_on_framelet(point, k, centres, rotations, optics):
    """(row, sample) of a point on the whole detector framelet at exposure k; NaN behind the camera or the body."""
    x, y, z = point[0] - centres[k, 0], point[1] - centres[k, 1], point[2] - centres[k, 2]
    rise = -(x * point[0] + y * point[1] + z * point[2])
    if rise < 0 and rise * rise > 0.0025 * (x * x + y * y + z * z) * (point[0] ** 2 + point[1] ** 2 + point[2] ** 2):
        return math.nan, math.nan  # three degrees below the horizon: the far side of the body
    r = rotations[k]
    row, column = detector_place(
        r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
        r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
        r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
        optics,
    )
    return (row + optics.line_offset) / optics.line_summing, (column + optics.sample_offset) / optics.sample_summing


@numba.njit(cache=True, parallel=True)
def _find(points, strip, optics, out_line, out_sample):
    """For each point the framelet whose middle it is nearest to, by secant steps over whole framelets."""
    centres, rotations = strip.centres, strip.rotations
    n, framelets = points.shape[0], centres.shape[0]
    first_slope, height, trimmed = strip.slope, strip.height, strip.trimmed
    middle = trimmed + height / 2
    stride = max(1, framelets // STEPS)
    for chunk in numba.prange((n + CHUNK - 1) // CHUNK):
        k, slope = -1, first_slope
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            p = points[i]
            out_line[i], out_sample[i] = math.nan, math.nan
            if not math.isfinite(p[0] + p[1] + p[2]):
                continue
            row, column = math.nan, math.nan
            if k >= 0:
                row, column = _place_on_framelet(p, k, centres, rotations, optics)
            if not math.isfinite(row):
                k, slope = -1, first_slope
                for j in range(0, framelets, stride):
                    r, c = _place_on_framelet(p, j, centres, rotations, optics)
                    if math.isfinite(r) and not abs(r - middle) >= abs(row - middle):
                        k, row, column = j, r, c
                if k < 0:
                    continue
            for _ in range(30):
                if slope == 0.0:
                    break
                step = round((middle - row) / slope)
                j = int(min(max(k + step, 0.0), framelets - 1.0))
                if j == k:
                    break
                r, c = _place_on_framelet(p, j, centres, rotations, optics)
                if not math.isfinite(r) or abs(r - middle) >= abs(row - middle):
                    break
                found = (r - row) / (j - k)
                if found * first_slope > 0:
                    slope = found
                k, row, column = j, r, c
            moving = True
            while (
                moving
            ):  # compare with the neighbours: secant steps may end one framelet off where two are about as near
                moving = False
                for j in (k - 1, k + 1):
                    if 0 <= j < framelets:
                        r, c = _place_on_framelet(p, j, centres, rotations, optics)
                        if abs(r - middle) < abs(row - middle):
                            k, row, column, moving = j, r, c, True
                            break
            within = row - trimmed
            if strip.flipped:
                within = height - within
            # before the first framelet and after the last a point lies outside the image, between two it is not seen
            if within < 0 and k > 0:
                if within < -EDGE:
                    continue
                within = 0.0
            if within >= height and k < framelets - 1:
                if within > height + EDGE:
                    continue
                within = height - 1e-9
            out_line[i] = k * height + within
            out_sample[i] = column
