"""Pinhole frame camera: every pixel's ray leaves one point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from schemas.errors import GeometryError
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
        return cls(focal_px=focal, **read.own_camera(document, where))

    @classmethod
    def looking_at(
        cls,
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
        if not distance > 0 or not 0 < field_of_view < np.pi:
            raise GeometryError(
                f"pinhole camera: expected two different places and a field of view in (0, 180) deg, found distance "
                f"{distance:g} m and {np.degrees(field_of_view):g} deg."
            )
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
        return cls(
            lines=size[1],
            samples=size[0],
            focal_px=(focal, focal),
            principal_point_px=(size[0] / 2, size[1] / 2),
            centre=position,
            rotation=np.stack([right, down, forward], axis=1),
            semi_axes=(radius, radius),
        )

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
