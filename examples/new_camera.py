"""A new camera in one file: a full-sky panorama from a lander, whose rows are elevations and columns azimuths.

Put a file like this into ``stages/physics/cameras/`` and it is known everywhere: ``open_camera``, ``project`` for images
with such a camera, ``render --camera``. Run it to see the round trip checked:

    python examples/new_camera.py
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from stages.physics.cameras import Camera, camera_from_document, register
from stages.physics.cameras import document as read
from stages.physics.cameras.base import Floats


@register
@dataclass(frozen=True, eq=False)
class Panorama(Camera):
    """sample grows with azimuth (0 to 360 deg, clockwise from the camera's y axis), line with the angle from its z axis.

    JSON: ``{"type": "panorama", "size_px": [samples, lines], "position_mcmf", "rotation_camera_to_mcmf"}``
    """

    kind: ClassVar[str] = "panorama"
    answers_to: ClassVar[tuple[str, ...]] = ("panorama",)

    lines: int
    samples: int
    centre: Floats
    rotation: Floats
    semi_axes: tuple[float, float] = (1737400.0, 1737400.0)

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Panorama:
        samples, lines = (int(v) for v in read.array(document, "size_px", where, (2,)))
        return cls(
            lines=lines,
            samples=samples,
            centre=read.array(document, "position_mcmf", where, (3,)),
            rotation=read.rotation(document, "rotation_camera_to_mcmf", where),
            semi_axes=read.body_axes(document, where),
        )

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        zenith = np.asarray(line, float) * np.pi / self.lines
        azimuth = np.asarray(sample, float) * 2 * np.pi / self.samples
        camera = np.stack([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)], axis=-1)
        direction = camera @ self.rotation.T
        return np.broadcast_to(self.centre, direction.shape), direction

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        x, y, z = np.moveaxis((np.asarray(points, float) - self.centre) @ self.rotation, -1, 0)
        line = np.arctan2(np.hypot(x, y), z) * self.lines / np.pi
        sample = np.arctan2(x, y) % (2 * np.pi) * self.samples / (2 * np.pi)
        return line, sample


def main() -> None:
    camera = camera_from_document(
        {
            "type": "panorama",
            "size_px": [3600, 1800],
            "position_mcmf": [1737402.0, 0.0, 0.0],  # two metres above the ground
            "rotation_camera_to_mcmf": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],  # z up, y north, x east
        },
        "panorama.json",
    )
    line, sample = np.meshgrid(np.linspace(1000, 1700, 50), np.linspace(10, 3590, 90), indexing="ij")
    points = camera.image_to_ground(line, sample, missing="error")
    back = camera.ground_to_image(points)
    print(f"round trip: {max(np.abs(back[0] - line).max(), np.abs(back[1] - sample).max()):.1e} px")


if __name__ == "__main__":
    main()
