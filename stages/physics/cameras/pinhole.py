"""Pinhole frame camera: every pixel's ray leaves one point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from schemas.errors import InputError
from schemas.files.user_files import check_keys
from stages.physics.cameras import document as read
from stages.physics.cameras.base import Camera, Floats, register
from stages.physics.cameras.distortion import FISHEYE, NONE, RADTAN, distort_arrays, pack, undistort_arrays


@register
@dataclass(frozen=True, eq=False)
class Pinhole(Camera):
    """sample = f_x X / Z + c_x, line = f_y Y / Z + c_y, with (X, Y, Z) in the camera: right, down, forward.

    focal_px : (f_x, f_y); principal_point_px : (sample, line) = (c_x, c_y), first pixel's centre at 0.5
    centre : (3,) place of the camera, body-fixed, m; rotation : (3, 3), takes camera vectors to body-fixed ones

    JSON: ``{"type": "pinhole", "focal_px": f or [fx, fy], "principal_point_px": [sample, line],
    "size_px": [samples, lines], "position_mcmf": [x, y, z], "rotation_camera_to_mcmf": 3 x 3 or [qx, qy, qz, qw]}``,
    and where the body is not the Moon ``"body"``: its name or radius in metres. ``"distortion"`` takes OpenCV's
    coefficients by name: ``{"k1", "k2", "p1", "p2"[, "k3"[, "k4", "k5", "k6"]]}`` (Brown-Conrady; absent ones are 0), or
    ``{"model": "fisheye", "k1", "k2", "k3", "k4"}``.

    distortion : code and coefficients of ``cameras.distortion``, of tangents (X / Z, Y / Z)
    """

    kind: ClassVar[str] = "pinhole"
    answers_to: ClassVar[tuple[str, ...]] = ("pinhole",)

    lines: int
    samples: int
    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    centre: Floats
    rotation: Floats
    semi_axes: tuple[float, float] = (1737400.0, 1737400.0)
    distortion: tuple[int, Floats] = (NONE, np.zeros(1))

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Pinhole:
        common = read.frame_camera(document, where, ("focal_px", "distortion"))
        focal = read.one_or_two(document, "focal_px", where, "focal lengths above 0 px")
        return cls(focal_px=focal, distortion=_read_distortion(document, where), **common)

    def to_document(self) -> dict[str, Any]:
        """The JSON document that :meth:`from_document` reads."""
        return {
            "type": self.kind,
            "focal_px": list(self.focal_px),
            "principal_point_px": list(self.principal_point_px),
            "size_px": [self.samples, self.lines],
            "position_mcmf": self.centre.tolist(),
            "rotation_camera_to_mcmf": self.rotation.tolist(),
            "body": str(self.semi_axes[0]),
        } | _distortion_document(*self.distortion)

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        x = (sample - self.principal_point_px[0]) / self.focal_px[0]
        y = (line - self.principal_point_px[1]) / self.focal_px[1]
        x, y = undistort_arrays(*self.distortion, x, y)
        camera = np.stack([x, y, np.ones_like(x)], axis=-1)
        direction = camera @ self.rotation.T
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return np.broadcast_to(self.centre, direction.shape), direction

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        camera = (np.asarray(points, float) - self.centre) @ self.rotation
        depth = np.where(camera[..., 2] > 0, camera[..., 2], np.nan)
        x, y = distort_arrays(*self.distortion, camera[..., 0] / depth, camera[..., 1] / depth)
        return self.focal_px[1] * y + self.principal_point_px[1], self.focal_px[0] * x + self.principal_point_px[0]


_BROWN, _FISHEYE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), ("k1", "k2", "k3", "k4")


def _read_distortion(document: Mapping[str, Any], where: str) -> tuple[int, Floats]:
    """(code, coefficients) of the key ``distortion``, of no distortion where there is none. Raises InputError."""
    if "distortion" not in document:
        return NONE, np.zeros(1)
    given, where = document["distortion"], f"{where}: 'distortion'"
    if not isinstance(given, Mapping):
        raise InputError(
            f"{where}: expected an object of OpenCV's coefficients, found {given!r:.60}; mend the camera model."
        )
    model = given.get("model", "brown")
    if model not in ("brown", "fisheye"):
        raise InputError(
            f"{where}: expected the model 'brown' or 'fisheye', found {model!r:.40}; mend the camera model."
        )
    code, names = (FISHEYE, _FISHEYE) if model == "fisheye" else (RADTAN, _BROWN)
    check_keys(given, ("model", *names), where)
    return code, pack(code, np.array([read.number(given, name, where, 0.0) for name in names]), where)


def _distortion_document(code: int, coefficients: Floats) -> dict[str, Any]:
    if code == NONE:
        return {}
    names = _FISHEYE if code == FISHEYE else _BROWN
    numbers = dict(zip(names, coefficients.tolist(), strict=False))
    return {"distortion": {"model": "fisheye" if code == FISHEYE else "brown"} | numbers}
