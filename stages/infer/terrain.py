"""The DEM of a scene as the network reads it: in rows, holes filled, continued beyond the map's edges."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import SCENE, open_artefact
from stages.pairs.holes import FILL_REACH, fill_holes
from stages.physics.maps.grid import check_same_body

STEP = 8  # px; the box around what is valid begins and ends at multiples of it
READ = 1024  # rows read at once: the surroundings that filling holes needs are read again with the next


class TerrainReader:
    """Reads windows of a DEM. elevation : (H, W) m, dem_valid : (H, W), arrays or HDF5 datasets"""

    def __init__(self, elevation: Any, dem_valid: Any) -> None:
        self.elevation, self.valid = elevation, dem_valid
        self._box = (0, 0, 0, 0)
        self._block = np.empty((0, 0), np.float32)  # the last that was read

    def __call__(self, first: int, last: int, left: int, right: int) -> NDArray[np.float32]:
        """Rows ``first`` .. ``last``, columns ``left`` .. ``right``, (last - first, right - left) float32 in m."""
        height, width = self.elevation.shape
        # Beyond the map its last row or column is repeated: the network's input has whole strides.
        a, b = min(max(first, 0), height - 1), min(max(last, 1), height)
        c, d = min(max(left, 0), width - 1), min(max(right, 1), width)
        found = self._filled(a, b, c, d)
        if (a, b, c, d) != (first, last, left, right):
            rows = np.clip(np.arange(first, last), a, b - 1) - a
            found = found[rows[:, None], np.clip(np.arange(left, right), c, d - 1) - c]
        return np.ascontiguousarray(found)

    def _filled(self, a: int, b: int, c: int, d: int) -> NDArray[np.float32]:
        r0, r1, c0, c1 = self._box
        if not (r0 <= a and b <= r1 and c0 == c and c1 == d):
            r0, r1 = a, min(self.elevation.shape[0], max(b, a + READ))
            self._box, self._block = (r0, r1, c, d), self._read(r0, r1, c, d)
        return self._block[a - r0 : b - r0]

    def _read(self, a: int, b: int, c: int, d: int) -> NDArray[np.float32]:
        height, width = self.elevation.shape
        r0, r1, c0, c1 = (
            max(0, a - FILL_REACH),
            min(height, b + FILL_REACH),
            max(0, c - FILL_REACH),
            min(width, d + FILL_REACH),
        )
        valid = self.valid[r0:r1, c0:c1].astype(bool)
        if valid[a - r0 : b - r0, c - c0 : d - c0].all():
            return self.elevation[a:b, c:d]
        return fill_holes(self.elevation[r0:r1, c0:c1], valid)[a - r0 : b - r0, c - c0 : d - c0]


def valid_part(dem_valid: Any, box: tuple[int, int, int, int]) -> tuple[int, int, int, int] | None:
    """The smallest box (row, col, height, width) around what is valid in a box, in steps of STEP; None where nothing is."""
    row, col, height, width = box
    rows, columns = np.zeros(height, bool), np.zeros(width, bool)
    for first in range(row, row + height, READ):
        part = dem_valid[first : min(row + height, first + READ), col : col + width].astype(bool)
        rows[first - row : first - row + len(part)] = part.any(axis=1)
        columns |= part.any(axis=0)
    if not rows.any():
        return None
    (top, high), (left, wide) = (_extent(known) for known in (rows, columns))
    return row + top, col + left, high, wide


def _extent(known: NDArray[np.bool_]) -> tuple[int, int]:
    """(first, length) of what is known along an axis, in steps of STEP."""
    first = int(known.argmax()) // STEP * STEP
    last = known.size - int(known[::-1].argmax())
    return first, min(known.size, -(-last // STEP) * STEP) - first


def check_body(scene: Path, body: str | None) -> None:
    """Refuse a body that a scene contradicts. Raises GeometryError."""
    with open_artefact(scene, SCENE) as file:
        check_same_body(scene, float(file.attrs["body_radius_m"]), body)
