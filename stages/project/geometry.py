"""Directions from the crops to the Sun and the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas import GeometryError
from stages.physics.images.table import Frame
from stages.physics.maps.grid import LocalFrames


@dataclass(frozen=True)
class Geometry:
    """Sun and camera of n crops in their own frames: unit vectors and metres, (n, 3); see Grid.local_frames."""

    sun: NDArray[np.float64]
    camera: NDArray[np.float64]


def crop_geometry(
    local: LocalFrames, elevation: NDArray[np.float64], radius: float, sun_position: NDArray, camera_position: NDArray
) -> Geometry:
    """Directions from crop centres at their mean ``elevation`` (n,) to Sun and camera (body-fixed, m)."""
    centre = local.up * (radius + elevation)[:, None]
    to_sun = sun_position - centre
    to_sun /= np.linalg.norm(to_sun, axis=1, keepdims=True)
    sun = np.einsum("nij,nj->ni", local.axes, to_sun)
    camera = np.einsum("nij,nj->ni", local.axes, camera_position - centre)
    return Geometry(sun, camera)


def check_directions(frame: Frame, geometry: Geometry) -> None:
    """Refuse a Sun or a camera below the horizontal plane of a crop. Raises GeometryError."""
    if geometry.sun[:, 2].min() <= 0:
        raise GeometryError(
            f"image '{frame.image_id}': the Sun is below the horizon at {int((geometry.sun[:, 2] <= 0).sum())} crop centres; "
            "check its sub-solar point (degrees east)."
        )
    if geometry.camera[:, 2].min() <= 0:
        raise GeometryError(
            f"image '{frame.image_id}': the camera is below the horizon at {int((geometry.camera[:, 2] <= 0).sum())} crop centres; "
            "check spacecraft_longitude_deg, spacecraft_latitude_deg and spacecraft_altitude_m."
        )
