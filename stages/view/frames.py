"""Directions over a map for a page: the local axes and pixel sizes at a few nodes, between which a shader interpolates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.physics.maps.grid import Grid

NODES = 17


@dataclass(frozen=True)
class Frames:
    """Local axes and pixel sizes at nodes spread evenly over a map.

    axes : (NODES, NODES, 3, 3) float32, grid-east, grid-north and up of each node in the axes of the map's middle
    pixel_size : (NODES, NODES, 2) float32, true m from row to row and from column to column, at height 0
    middle : (3, 3), the middle's axes in body-fixed coordinates; convergence_deg : of true north there
    """

    axes: NDArray[np.float32]
    pixel_size: NDArray[np.float32]
    middle: NDArray[np.float64]
    convergence_deg: float


def make_frames(grid: Grid) -> Frames:
    """Nodes spread evenly from the first to the last pixel centre."""
    rows, cols = np.meshgrid(
        np.linspace(0, grid.height - 1, NODES), np.linspace(0, grid.width - 1, NODES), indexing="ij"
    )
    local = grid.local_frames(rows.ravel(), cols.ravel())
    centre = grid.local_frames((grid.height - 1) / 2, (grid.width - 1) / 2)
    middle = centre.axes[0]
    axes = np.einsum("nij,kj->nik", local.axes, middle).reshape(NODES, NODES, 3, 3)
    size = local.pixel_size.reshape(NODES, NODES, 2)
    return Frames(axes.astype(np.float32), size.astype(np.float32), middle, float(centre.convergence_deg[0]))
