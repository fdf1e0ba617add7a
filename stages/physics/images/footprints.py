"""Where each image shows something of the map, by cells: a tilted strip fills few of the cells of its box."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from stages.physics.maps.window import Box

CELL_PX = 64
MARGIN_PX = 16  # by which registration may move an image, and more


@dataclass(frozen=True)
class Footprint:
    """box : that holds all valid pixels of the image; cells : (h, w) whether each has any, from the box's corner on"""

    box: Box
    cells: NDArray[np.bool_]

    def within(self, box: Box) -> Box | None:
        """The part of ``box`` that holds all that the image shows of it, None where it shows nothing."""
        rows, cols = (_span(box[axis] - self.box[axis], box[axis + 2]) for axis in (0, 1))
        part = self.cells[rows, cols]
        if not part.any():
            return None
        top, bottom = _reach(np.asarray(part.any(axis=1)), self.box[0] + CELL_PX * rows.start, box[0], box[2])
        left, right = _reach(np.asarray(part.any(axis=0)), self.box[1] + CELL_PX * cols.start, box[1], box[3])
        return (top, left, bottom - top, right - left) if bottom > top and right > left else None


def _span(first: int, length: int) -> slice:
    """The cells that pixels ``first`` .. ``first + length`` and the margin around them touch."""
    last = -(-(first + length + MARGIN_PX) // CELL_PX)
    return slice(max(0, (first - MARGIN_PX) // CELL_PX), max(0, last))


def _reach(seen: NDArray[np.bool_], start: int, first: int, length: int) -> tuple[int, int]:
    """First and last + 1 of the pixels first .. first + length that lie in or near cells seen, which begin at ``start``."""
    cells = np.flatnonzero(seen)
    near = start + CELL_PX * int(cells[0]) - MARGIN_PX, start + CELL_PX * int(cells[-1] + 1) + MARGIN_PX
    return max(first, near[0]), min(first + length, near[1])


def read_footprint(valid: h5py.Dataset, frame: int, box: Box) -> Footprint:
    """The footprint of an image. valid : (frame, y, x) masks of a scene; box : that holds all valid pixels of the image"""
    row, col, height, width = box
    cells = np.zeros((-(-height // CELL_PX), -(-width // CELL_PX)), bool)
    starts = np.arange(0, width, CELL_PX)
    for k in range(len(cells)):
        first = row + k * CELL_PX
        strip = valid[frame, first : min(row + height, first + CELL_PX), col : col + width]
        cells[k] = np.logical_or.reduceat(strip.any(axis=0), starts)
    return Footprint(box, cells)
