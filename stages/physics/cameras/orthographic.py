"""Orthographic camera: parallel rays, as of a camera infinitely far away."""

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
class Orthographic(Camera):
    """sample = X / p_x + c_x, line = Y / p_y + c_y, with (X, Y, Z) in the camera: right, down, forward.

    pixel_size : (p_x, p_y), m; principal_point_px : (sample, line), first pixel's centre at 0.5
    centre : (3,) body-fixed place of the image plane, m, outside the body; rotation : (3, 3), camera to body-fixed

    JSON: ``{"type": "orthographic", "pixel_size": p or [px, py], "principal_point_px", "size_px", "position_mcmf",
    "rotation_camera_to_mcmf"}``, the rest as for ``pinhole``.
    """

    kind: ClassVar[str] = "orthographic"
    answers_to: ClassVar[tuple[str, ...]] = ("orthographic",)

    lines: int
    samples: int
    pixel_size: tuple[float, float]
    principal_point_px: tuple[float, float]
    centre: Floats
    rotation: Floats
    semi_axes: tuple[float, float] = (1737400.0, 1737400.0)

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Orthographic:
        pixel = read.one_or_two(document, "pixel_size", where, "pixel sizes above 0 m")
        return cls(pixel_size=pixel, **read.frame_camera(document, where, ("pixel_size",)))

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        x = (sample - self.principal_point_px[0]) * self.pixel_size[0]
        y = (line - self.principal_point_px[1]) * self.pixel_size[1]
        origin = self.centre + x[..., None] * self.rotation[:, 0] + y[..., None] * self.rotation[:, 1]
        return origin, np.broadcast_to(self.rotation[:, 2], origin.shape)

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        camera = (np.asarray(points, float) - self.centre) @ self.rotation
        ahead = np.where(camera[..., 2] > 0, 1.0, np.nan)
        sample = camera[..., 0] / self.pixel_size[0] + self.principal_point_px[0]
        line = camera[..., 1] / self.pixel_size[1] + self.principal_point_px[1]
        return line * ahead, sample * ahead
