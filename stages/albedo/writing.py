"""The map with albedo: what it had before, and what the photographs add."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas import ArtefactWriter
from stages.photographs.calibrate import COSINES, Calibration
from stages.photographs.pyramid import LEVELS
from stages.physics.images.table import Frame
from stages.physics.maps.window import Box


class Maps:
    """Takes blocks of albedo, its standard deviation and the number of images."""

    def __init__(self, writer: ArtefactWriter, frames: Sequence[Frame], calibration: Calibration) -> None:
        self._maps = [writer.dataset(name) for name in ("albedo", "albedo_std", "albedo_images")]
        self._writer, self._frames, self._calibration = writer, frames, calibration

    def put(self, block: Box, *values: NDArray) -> None:
        """Write one block of every map, each (height, width)."""
        row, col, height, width = block
        for target, part in zip(self._maps, values, strict=True):
            target[row : row + height, col : col + width] = part

    def close(self) -> None:
        """Write what is known of the images."""
        writer, frames, found = self._writer, self._frames, self._calibration
        writer.write("albedo_image_id", [f.image_id for f in frames])
        writer.write("albedo_gain", found.gain)
        writer.write("albedo_offset", found.offset)
        writer.write("albedo_subsolar_longitude_deg", np.array([f.subsolar_longitude_deg for f in frames]))
        writer.write("albedo_subsolar_latitude_deg", np.array([f.subsolar_latitude_deg for f in frames]))
        writer.write("albedo_band_px", 2.0 ** np.arange(LEVELS + 1))
        writer.write("albedo_band_std", np.sqrt(found.spread.shared))
        writer.write("albedo_image_std", np.sqrt(found.spread.own))
        writer.write("albedo_bin_cos_incidence", 0.5 * (COSINES[1:] + COSINES[:-1]))
        writer.write("albedo_interval_68", found.interval[0])
        writer.write("albedo_interval_95", found.interval[1])
        writer.write("albedo_interval_shadow", found.shadow)
