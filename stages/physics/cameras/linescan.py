"""Line-scan camera from an ALE/CSM ISD (LROC NAC, Kaguya TC, CTX, HRSC, ...): every line has its own time and pose."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numba
import numpy as np
from numpy.typing import ArrayLike

from schemas.errors import GeometryError, InputError
from stages.physics.cameras import document as read
from stages.physics.cameras.base import Floats, register
from stages.physics.cameras.isd import Detector, Exposure, IsdCamera, detector_place
from stages.physics.cameras.tables import EvenTable, lagrange

ISD_FIRST_LINE = 0.5  # 'line_scan_rate' counts its lines from 0.5 where the image begins
COARSE_NODES = (2048, 131072)
CHUNK = 8192  # points per parallel piece


@register
@dataclass(frozen=True, eq=False)
class LineScan(IsdCamera):
    """One line at a time through the lens of ``detector``; times in s from ``centre_time`` (TDB since J2000).

    line_starts, line_times, line_rates : (k,) image line, time and seconds per line of each stretch of constant rate
    positions : camera, body-fixed, m; pointing : quaternions (scalar first), camera to body-fixed; sun : body-fixed, m
    """

    kind: ClassVar[str] = "line-scan"
    answers_to: ClassVar[tuple[str, ...]] = ("USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL",)

    centre_time: float
    line_starts: Floats
    line_times: Floats
    line_rates: Floats
    positions: EvenTable
    pointing: EvenTable
    sun: EvenTable
    _search: _Search | None = field(default=None, repr=False)

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> LineScan:
        exposure = Exposure.from_document(document, where)
        detector = Detector.from_document(document, where)
        rates = read.array(document, "line_scan_rate", where, (-1, 3))
        if len(rates) == 0 or (np.diff(rates[:, 0]) <= 0).any() or (rates[:, 2] == 0).any():
            raise InputError(
                f"{where}: expected rising lines and line times other than 0 in 'line_scan_rate', found "
                f"{rates.tolist()!r:.80}."
            )
        if (rates[:, 2] > 0).any() and (rates[:, 2] < 0).any():
            raise InputError(f"{where}: expected 'line_scan_rate' to run one way in time, found both signs.")
        positions, pointing, sun = exposure.even_tables()
        camera = cls(
            lines=exposure.lines,
            samples=exposure.samples,
            semi_axes=exposure.semi_axes,
            detector=detector,
            centre_time=exposure.centre_time,
            line_starts=rates[:, 0] - ISD_FIRST_LINE,
            line_times=rates[:, 1].copy(),
            line_rates=rates[:, 2].copy(),
            positions=positions,
            pointing=pointing,
            sun=sun,
        )
        ends = camera.times([0.0, camera.lines])
        exposure.check_covers(float(ends.min()), float(ends.max()), where)
        middle = float(ends.mean())
        facing = detector.facing(positions.at(middle), camera.rotations(middle)[:, 2])
        camera = replace(camera, detector=facing)
        return replace(camera, _search=_Search.for_camera(camera, where))

    def times(self, line: ArrayLike) -> Floats:
        """Seconds from ``centre_time`` of image lines.

        line : (...,) px; returns the same shape
        """
        line = np.asarray(line, float)
        k = np.clip(np.searchsorted(self.line_starts, line, side="right") - 1, 0, None)
        return self.line_times[k] + self.line_rates[k] * (line - self.line_starts[k])

    def rotations(self, times: ArrayLike) -> Floats:
        """(..., 3, 3) camera to body-fixed."""
        quaternions = self.pointing.at(times)
        return read.quaternion_matrix(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        times = self.times(line)
        camera = self.detector.directions(np.zeros_like(sample), sample)
        return self.positions.at(times), (self.rotations(times) @ camera[..., None])[..., 0]

    def position(self, line: ArrayLike, sample: ArrayLike | None = None) -> Floats:
        return self.positions.at(self.times(line))

    def sun_position(self, line: ArrayLike) -> Floats:
        return self.sun.at(self.times(line))

    def ephemeris_time(self, line: ArrayLike) -> Floats:
        return self.centre_time + self.times(line)

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        points = np.asarray(points, float)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        line, sample = np.empty(len(flat)), np.empty(len(flat))
        search = self._search
        assert search is not None  # built with every camera
        _find(
            flat, search.coarse, search.guess, search.slope, self.positions, self.pointing, self.detector.optics,
            self.line_starts, self.line_times, self.line_rates, line, sample,
        )  # fmt: skip
        return line.reshape(points.shape[:-1]), sample.reshape(points.shape[:-1])


@dataclass(frozen=True)
class _Search:
    """Aids for the search of a point's line: a table that is interpolated linearly, and a first guess.

    coarse : (n, 12) positions and rows of the body-to-camera rotations
    guess : (4,) time of a point = g0 + g1 x + g2 y + g3 z; slope : detector lines per second
    """

    coarse: EvenTable
    guess: Floats
    slope: float

    @classmethod
    def for_camera(cls, camera: LineScan, where: str) -> _Search:
        margin = max(2.0, 0.01 * camera.lines)
        ends = camera.times(np.array([-margin, camera.lines + margin]))
        wanted = 4 * max(len(camera.positions.values), len(camera.pointing.values))
        nodes = int(np.clip(wanted, *COARSE_NODES))
        times = np.linspace(ends.min(), ends.max(), nodes)
        rotation = camera.rotations(times)
        coarse = np.concatenate([camera.positions.at(times), np.swapaxes(rotation, -1, -2).reshape(nodes, 9)], axis=1)
        line, sample, height = (
            v.ravel()
            for v in np.meshgrid(
                np.linspace(0, camera.lines, 9), np.linspace(0, camera.samples, 3), [0.0, 1000.0], indexing="ij"
            )
        )
        points = camera.image_to_ground(line, sample, height)
        seen = np.isfinite(points).all(-1)
        if not seen.any():
            points, seen = camera.image_to_ground(line, sample, height, missing="nearest"), np.ones(line.shape, bool)
        matrix = np.concatenate([np.ones((seen.sum(), 1)), points[seen]], axis=1)
        scale = np.abs(matrix).max(axis=0)
        scale[scale == 0] = 1.0
        guess = np.linalg.lstsq(matrix / scale, camera.times(line[seen]), rcond=1e-12)[0] / scale
        # how fast points cross the detector, at the middle of what is seen
        k = np.flatnonzero(seen)[seen.sum() // 2]
        half = 0.5 * abs(float(np.median(camera.line_rates)))
        middle = camera.times(line[k])
        rows = [
            camera.detector.places(camera.rotations(t).T @ (points[k] - camera.positions.at(t)))[0]
            * camera.detector.summing[0]
            for t in (middle - half, middle + half)
        ]
        slope = float(rows[1] - rows[0]) / (2 * half)
        if not abs(slope) * 2 * half > 1e-6:  # detector px per line
            raise GeometryError(
                f"{where}: expected a camera that moves over the ground, found none; check its tables of position and "
                "pointing."
            )
        return cls(EvenTable(float(times[0]), float(times[1] - times[0]), coarse), guess, slope)


@numba.njit(cache=True)
def _line_of_time(time, line_starts, line_times, line_rates):
    k = line_starts.size - 1
    while k > 0 and (time - line_times[k]) * line_rates[k] < 0:  # not there yet, whichever way time runs
        k -= 1
    return line_starts[k] + (time - line_times[k]) / line_rates[k]


@numba.njit(cache=True, parallel=True, fastmath=False)
def _find(
    points, coarse, guess, slope, positions, pointing, optics, line_starts, line_times, line_rates, out_line, out_sample
):
    """For each point the time at which it lies on the detector's line.

    A secant search in the coarse table comes within a small part of a pixel; the last step is taken on the polynomials
    themselves, so that the answer does not depend on the coarse table.
    """
    n = points.shape[0]
    start, step, entries = coarse
    last = entries.shape[0] - 1
    first_time, last_time = start, start + last * step
    tolerance = 1e-5 * abs(slope * line_rates[0])  # of a line
    for chunk in numba.prange((n + CHUNK - 1) // CHUNK):
        place, turn = np.empty(3), np.empty(4)
        # Start from the point before: the error of its first guess, how fast it crossed the line and how far it moved
        # sideways meanwhile.
        correction, gradient, sideways = 0.0, slope, 0.0
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            out_line[i] = math.nan
            out_sample[i] = math.nan
            affine = guess[0] + guess[1] * px + guess[2] * py + guess[3] * pz
            if not math.isfinite(affine):
                correction = 0.0
                continue
            time = min(max(affine + correction, first_time), last_time)
            before_time, before_row, before_column = math.nan, math.nan, math.nan
            row, column = math.nan, math.nan
            good = False
            for _ in range(40):
                x = (time - start) / step
                j = min(max(int(x), 0), last - 1)
                f = x - j
                g = 1.0 - f
                a, b = entries[j], entries[j + 1]
                vx = px - (g * a[0] + f * b[0])
                vy = py - (g * a[1] + f * b[1])
                vz = pz - (g * a[2] + f * b[2])
                cx = (g * a[3] + f * b[3]) * vx + (g * a[4] + f * b[4]) * vy + (g * a[5] + f * b[5]) * vz
                cy = (g * a[6] + f * b[6]) * vx + (g * a[7] + f * b[7]) * vy + (g * a[8] + f * b[8]) * vz
                cz = (g * a[9] + f * b[9]) * vx + (g * a[10] + f * b[10]) * vy + (g * a[11] + f * b[11]) * vz
                row, column = detector_place(cx, cy, cz, optics)
                row += optics.line_offset
                if not math.isfinite(row):
                    break
                if before_time == before_time and time != before_time:
                    secant = (row - before_row) / (time - before_time)
                    if abs(before_row) > tolerance and secant * slope > 0:
                        gradient = secant
                        sideways = (column - before_column) / (row - before_row)
                if abs(row) < tolerance:
                    good = True
                    break
                before_time, before_row, before_column = time, row, column
                wanted = time - row / gradient
                time = min(max(wanted, first_time), last_time)
                if time == before_time:  # held at the end of the table: the image never looks there
                    break
            if not good:
                correction, gradient = 0.0, slope
                continue
            for _ in range(8):
                lagrange(positions, time, place)
                lagrange(pointing, time, turn)
                vx, vy, vz = px - place[0], py - place[1], pz - place[2]
                w, qx, qy, qz = turn[0], -turn[1], -turn[2], -turn[3]
                norm = w * w + qx * qx + qy * qy + qz * qz
                tx = 2.0 * (qy * vz - qz * vy) / norm
                ty = 2.0 * (qz * vx - qx * vz) / norm
                tz = 2.0 * (qx * vy - qy * vx) / norm
                cx = vx + w * tx + qy * tz - qz * ty
                cy = vy + w * ty + qz * tx - qx * tz
                cz = vz + w * tz + qx * ty - qy * tx
                row, column = detector_place(cx, cy, cz, optics)
                row += optics.line_offset
                time -= row / gradient
                if not abs(row) > tolerance:
                    break
            if abs(row) <= tolerance:
                correction = time - affine
                out_line[i] = _line_of_time(time, line_starts, line_times, line_rates)
                out_sample[i] = (column - sideways * row + optics.sample_offset) / optics.sample_summing
            else:
                correction, gradient = 0.0, slope
