"""The picture that stands on a page where the browser cannot relight the map."""

from __future__ import annotations

from typing import Any, cast

import cv2
import numpy as np

from stages.common.arrays import Floats32
from stages.physics.terrain.shading import Light, shade_block
from stages.physics.terrain.sun import sun_from_angles
from stages.physics.terrain.sun_visibility import SunHorizon
from stages.physics.terrain.surface import Surface
from stages.view.layers import Content, block_mean, coarse_grid

LARGEST_PX = 720
GAMMA = 2.2
QUALITY = 82


def still_jpeg(content: Content, sun_azimuth_deg: float, sun_elevation_deg: float) -> bytes:
    """The map under one Sun as `lunargr render` would show it, at most 720 px a side."""
    factor = max(1, -(-max(content.elevation.shape) // LARGEST_PX))
    elevation = block_mean(content.elevation, factor)
    coefficients = np.stack([block_mean(layer.values, factor) for layer in content.coefficients])
    small = coarse_grid(content.grid, factor, elevation.shape)
    sun = sun_from_angles(sun_azimuth_deg, sun_elevation_deg, small)
    relief = float(np.nanmax(elevation) - np.nanmin(elevation))
    # arrays slice as the file's variables do
    surface = Surface(cast(Any, "page"), small, cast(Any, elevation), content.model, cast(Any, coefficients), elevation)
    light = Light(sun, SunHorizon(elevation, small, sun, relief), None)
    return _jpeg(shade_block(surface, light, 0, 0, small.height, small.width)["image"])


def _jpeg(image: Floats32) -> bytes:
    known = image[np.isfinite(image)]
    white = max(float(np.percentile(known, 99.5)) if known.size else 1.0, 1e-9)
    grey = np.clip(np.nan_to_num(image) / white, 0.0, 1.0) ** (1 / GAMMA) * 255
    return cv2.imencode(".jpg", np.rint(grey).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
