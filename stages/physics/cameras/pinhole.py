"""Pinhole frame camera: every pixel's ray leaves one point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from stages.physics.cameras import document as read
from stages.physics.cameras.base import Camera, Floats, register


@register
@dataclass(frozen=True, eq=False)
class Pinhole(Camera):
    """sample = f_x X / Z + c_x, line = f_y Y / Z + c_y, with (X, Y, Z) in the camera: right, down, forward.

    focal_px : (f_x, f_y); principal_point_px : (sample, line) = (c_x, c_y), first pixel's centre at 0.5
    centre : (3,) place of the camera, body-fixed, m; rotation : (3, 3), takes camera vectors to body-fixed ones

    JSON: ``{"type": "pinhole", "focal_px": f or [fx, fy], "principal_point_px": [sample, line],
    "size_px": [samples, lines], "position_mcmf": [x, y, z], "rotation_camera_to_mcmf": 3 x 3 or [qx, qy, qz, qw]}``,
    and where the body is not the Moon ``"body"``: its name or radius in metres.
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

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Pinhole:
        focal = read.one_or_two(document, "focal_px", where, "focal lengths above 0 px")
        return cls(focal_px=focal, **read.frame_camera(document, where))

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
        }

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        x = (sample - self.principal_point_px[0]) / self.focal_px[0]
        y = (line - self.principal_point_px[1]) / self.focal_px[1]
        camera = np.stack([x, y, np.ones_like(x)], axis=-1)
        direction = camera @ self.rotation.T
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return np.broadcast_to(self.centre, direction.shape), direction

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        camera = (np.asarray(points, float) - self.centre) @ self.rotation
        depth = np.where(camera[..., 2] > 0, camera[..., 2], np.nan)
        sample = self.focal_px[0] * camera[..., 0] / depth + self.principal_point_px[0]
        line = self.focal_px[1] * camera[..., 1] / depth + self.principal_point_px[1]
        return line, sample
