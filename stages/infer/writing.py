"""Strips of windows into the artefact."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import ArtefactWriter
from stages.infer.windows import CHUNK, WIDEST
from stages.physics.maps.geotiff import MapTiff


class MapWriter:
    """Writes parts of a map to its artefact, and copies the DEM there.

    elevation, dem_valid : (H, W), the scene's; own : (first, last + 1) row of the shard; tiff : gets what is predicted
        too
    """

    def __init__(
        self, writer: ArtefactWriter, elevation: Any, dem_valid: Any, own: tuple[int, int], tiff: MapTiff | None = None
    ) -> None:
        self.coefficients, self.valid = writer.dataset("coefficients"), writer.dataset("valid")
        self.deviations = writer.dataset("coefficients_std") if "coefficients_std" in writer.file else None
        self.count = len(self.coefficients)
        self.channels = self.count + (0 if self.deviations is None else len(self.deviations))
        self.copied = writer.dataset("elevation")
        self.elevation, self.dem_valid, self.tiff = elevation, dem_valid, tiff
        columns = range(0, self.copied.shape[1], WIDEST)
        self._to_copy = itertools.product(range(own[0], own[1], CHUNK), columns)
        self._end = own[1]

    def copy_elevation(self) -> bool:
        """Copy some chunks; returns whether there were any left. Between strips, while the network works on."""
        for row, col in self._to_copy:
            part = np.s_[row : min(self._end, row + CHUNK), col : col + WIDEST]
            self.copied[part] = self.elevation[part]
            return True
        return False

    def put(self, row: int, col: int, values: NDArray[np.float32]) -> None:
        """Write a strip: coefficients and deviations where the DEM is valid, NaN elsewhere.

        values : (channels, n, w), changed in place
        """
        part = np.s_[row : row + values.shape[1], col : col + values.shape[2]]
        mask = self.dem_valid[part].astype(bool)
        if not mask.all():
            values[:, ~mask] = np.nan
        self.coefficients[(slice(None), *part)] = values[: self.count]
        if self.deviations is not None:
            self.deviations[(slice(None), *part)] = values[self.count :]
        self.valid[part] = mask
        if self.tiff:
            self.tiff.put(row, col, values)
