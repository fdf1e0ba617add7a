"""Strips of windows into the artefact: as they come, or blended where windows overlap."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import ArtefactWriter
from stages.infer.windows import CHUNK, WIDEST, Box, blend_weights
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

    def put(self, row: int, col: int, values: NDArray[np.float32], known: NDArray[np.bool_] | None = None) -> None:
        """Write a strip: coefficients and deviations where the DEM is valid, NaN elsewhere.

        values : (channels, n, w), changed in place; known : (n, w), where there are values at all, everywhere if None
        """
        part = np.s_[row : row + values.shape[1], col : col + values.shape[2]]
        mask = self.dem_valid[part].astype(bool)
        if known is not None:
            mask &= known
        if not mask.all():
            values[:, ~mask] = np.nan
        self.coefficients[(slice(None), *part)] = values[: self.count]
        if self.deviations is not None:
            self.deviations[(slice(None), *part)] = values[self.count :]
        self.valid[part] = mask
        if self.tiff:
            self.tiff.put(row, col, values)


class Blend:
    """Weighted sums of overlapping windows that come row by row; only the rows that more windows may touch are kept."""

    def __init__(self, outputs: MapWriter, overlap: int, own: tuple[int, int]) -> None:
        self.outputs, self.overlap, self.own = outputs, overlap, own
        _, self.height, self.width = outputs.coefficients.shape
        self.total = np.zeros((outputs.channels, 0, self.width), np.float32)
        self.weight = np.zeros((0, self.width), np.float32)
        self.top = own[0]

    def begin(self, box: Box) -> None:
        """Make room for a window, and write the rows above it, to which no window contributes any more."""
        row, _, height, _ = box
        if row > self.top:
            self.flush(row)
        missing = row + height - self.top - len(self.weight)
        if missing > 0:
            self.total = np.concatenate(
                [self.total, np.zeros((len(self.total), missing, self.width), np.float32)], axis=1
            )
            self.weight = np.concatenate([self.weight, np.zeros((missing, self.width), np.float32)])

    def add(self, box: Box, row: int, col: int, values: NDArray[np.float32]) -> None:
        """values : (C, n, w), of the window ``box``"""
        r0, c0, h, w = box
        rows, columns = row - r0, col - c0
        down = blend_weights(r0, r0 + h, self.overlap, self.height)[rows : rows + values.shape[1]]
        across = blend_weights(c0, c0 + w, self.overlap, self.width)[columns : columns + values.shape[2]]
        weights = down[:, None] * across
        skip = max(0, self.top - row)  # a shard's first window may begin above its rows
        part = np.s_[row + skip - self.top : row - self.top + values.shape[1], col : col + values.shape[2]]
        if skip < values.shape[1]:
            self.total[(slice(None), *part)] += (values * weights)[:, skip:]
            self.weight[part] += weights[skip:]

    def flush(self, bottom: int) -> None:
        """Write the rows above ``bottom``."""
        a, b = max(self.top, self.own[0]), min(bottom, self.own[1], self.top + len(self.weight))
        if b > a:
            part = slice(a - self.top, b - self.top)
            weight = self.weight[part]
            values = self.total[:, part]
            values /= np.maximum(weight, np.float32(1e-12))
            self.outputs.put(a, 0, values, weight > 0)
        gone = bottom - self.top
        self.total, self.weight, self.top = self.total[:, gone:], self.weight[gone:], bottom
