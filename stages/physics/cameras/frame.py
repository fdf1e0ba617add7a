"""Framing camera from an ALE/CSM ISD: one exposure for the whole image (LROC WAC frames, Apollo Metric, Dawn FC, ...)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from stages.physics.cameras.base import Floats, register
from stages.physics.cameras.isd import Detector, Exposure, IsdCamera


@register
@dataclass(frozen=True, eq=False)
class Frame(IsdCamera):
    """Lens, distortion and detector of an ISD at its centre time.

    centre : (3,) place of the camera, body-fixed, m; rotation : (3, 3), takes camera vectors to body-fixed ones
    sun : (3,), body-fixed, m; time : s of TDB since J2000
    """

    kind: ClassVar[str] = "frame"
    answers_to: ClassVar[tuple[str, ...]] = ("USGS_ASTRO_FRAME_SENSOR_MODEL",)

    centre: Floats
    rotation: Floats
    sun: Floats
    time: float

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Frame:
        exposure = Exposure.from_document(document, where)
        now = np.zeros(1)
        exposure.check_covers(0.0, 0.0, where)
        body = exposure.body.at(now)[0]
        centre, rotation = body @ exposure.positions.at(now)[0], body @ exposure.pointing.at(now)[0].T
        return cls(
            lines=exposure.lines,
            samples=exposure.samples,
            semi_axes=exposure.semi_axes,
            detector=Detector.from_document(document, where).facing(centre, rotation[:, 2]),
            centre=centre,
            rotation=rotation,
            sun=body @ exposure.sun.at(now)[0],
            time=exposure.centre_time,
        )

    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        direction = self.detector.directions(line, sample) @ self.rotation.T
        return np.broadcast_to(self.centre, direction.shape), direction

    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        return self.detector.places((np.asarray(points, float) - self.centre) @ self.rotation)

    def sun_position(self, line: ArrayLike) -> Floats:
        return np.broadcast_to(self.sun, np.shape(line) + (3,))

    def ephemeris_time(self, line: ArrayLike) -> Floats:
        return np.full(np.shape(line), self.time)
