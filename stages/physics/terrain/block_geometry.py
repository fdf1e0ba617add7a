"""Photometric geometry of map blocks: slopes, Sun and camera at every pixel of a map of any size.

Directions turn by 1 deg per 30 km on the Moon and pixels stretch with the projection, so both are taken from the
projection at nodes a few dozen pixels apart and interpolated, which is exact to 1e-8 rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import torch

from stages.common.arrays import Floats, Floats32
from stages.physics.formation.geometry import Angles, photometric_angles
from stages.physics.maps.grid import Grid

NODE_PX = 64


@dataclass(frozen=True)
class BlockGeometry:
    """Per pixel (h, w) float32, in axes along the grid (east, north, up).

    sun, view : 3, unit vectors; slopes : 2, to the east and north; angles : of the ground
    depth : m to the camera, NaN for a view from straight above
    """

    sun: Floats32
    view: Floats32
    slopes: Floats32
    angles: Angles
    depth: Floats32
    longitude_deg: Floats32
    latitude_deg: Floats32

    @property
    def cos_incidence(self) -> Floats32:
        """(h, w)"""
        return self.angles.cos_incidence.numpy()

    @property
    def sun_elevation(self) -> Floats32:
        """(h, w) rad above the local horizontal."""
        return np.arcsin(np.clip(self.sun[2], -1.0, 1.0))


def block_geometry(
    grid: Grid, row: int, col: int, elevation: Floats32, sun_position: Floats, camera_position: Floats | None
) -> BlockGeometry:
    """Geometry of the block whose first pixel is (row, col).

    elevation : (h + 2, w + 2), m: the block and one pixel around it, NaN outside the map
    sun_position, camera_position : (3,), body-fixed, m; None = the camera is straight above every pixel
    """
    height, width = elevation.shape[0] - 2, elevation.shape[1] - 2
    node_rows = np.linspace(0, height - 1, max(2, -(-height // NODE_PX) + 1))
    node_cols = np.linspace(0, width - 1, max(2, -(-width // NODE_PX) + 1))
    rows, cols = np.meshgrid(row + node_rows, col + node_cols, indexing="ij")
    local = grid.local_frames(rows.ravel(), cols.ravel())
    base = local.up * grid.radius
    sun = sun_position - base
    sun /= np.linalg.norm(sun, axis=1, keepdims=True)
    camera = np.zeros_like(sun) if camera_position is None else camera_position - base
    fields = np.concatenate(
        [
            np.einsum("nij,nj->ni", local.axes, sun),
            np.einsum("nij,nj->ni", local.axes, camera),
            1.0 / local.pixel_size[:, 1:],
            1.0 / local.pixel_size[:, :1],
            local.up,
        ],
        axis=1,
    ).reshape(*rows.shape, 11)
    out = np.empty((11, height, width), np.float32)
    step_row = node_rows[1] - node_rows[0] if height > 1 else 1.0
    step_col = node_cols[1] - node_cols[0] if width > 1 else 1.0
    _geometry(np.asarray(elevation, np.float32), fields, step_row, step_col, grid.radius, camera_position is None, out)
    slopes, toward_sun, view = (torch.from_numpy(v)[None] for v in (out[0:2], out[2:5], out[5:8]))
    vx, vy, vz = view.unbind(1)
    angles = photometric_angles(slopes[:, 0], slopes[:, 1], toward_sun, (vx, vy, vz))
    cosines = angles.cos_incidence, angles.cos_emission, angles.cos_phase
    return BlockGeometry(out[2:5], out[5:8], out[0:2], Angles(*(c[0] for c in cosines)), *out[8:])


@numba.njit(cache=True, inline="always")
def slope_difference(before, here, after):
    """Central where both neighbours are known, one-sided where one is, 0 where none is."""
    central = 0.5 * (after - before)
    if central == central:
        return central
    if after == after:
        return after - here
    if before == before:
        return here - before
    return 0.0


@numba.njit(cache=True, parallel=True)
def _geometry(z, fields, step_row, step_col, radius, above, out):
    height, width = out.shape[1], out.shape[2]
    count = fields.shape[2]
    for r in numba.prange(height):
        j = min(int(r / step_row), fields.shape[0] - 2)
        v = r / step_row - j
        values = np.empty(count)
        for c in range(width):
            i = min(int(c / step_col), fields.shape[1] - 2)
            u = c / step_col - i
            for k in range(count):
                values[k] = (1.0 - v) * ((1.0 - u) * fields[j, i, k] + u * fields[j, i + 1, k]) + v * (
                    (1.0 - u) * fields[j + 1, i, k] + u * fields[j + 1, i + 1, k]
                )
            here = float(z[r + 1, c + 1])
            stretch = radius / (radius + here)  # a pixel is wider at height
            east = slope_difference(float(z[r + 1, c]), here, float(z[r + 1, c + 2])) * values[6] * stretch
            north = slope_difference(float(z[r + 2, c + 1]), here, float(z[r, c + 1])) * values[7] * stretch
            sx, sy, sz = values[0], values[1], values[2]
            norm = 1.0 / np.sqrt(sx * sx + sy * sy + sz * sz)
            sx, sy, sz = sx * norm, sy * norm, sz * norm
            vx, vy, vz, depth = 0.0, 0.0, 1.0, np.nan
            if not above:
                vx, vy, vz = values[3], values[4], values[5] - here
                depth = np.sqrt(vx * vx + vy * vy + vz * vz)
                vx, vy, vz = vx / depth, vy / depth, vz / depth
            out[0, r, c], out[1, r, c] = east, north
            out[2, r, c], out[3, r, c], out[4, r, c] = sx, sy, sz
            out[5, r, c], out[6, r, c], out[7, r, c] = vx, vy, vz
            out[8, r, c] = depth
            out[9, r, c] = np.degrees(np.arctan2(values[9], values[8]))
            out[10, r, c] = np.degrees(np.arctan2(values[10], np.sqrt(values[8] ** 2 + values[9] ** 2)))
            if here != here:
                for k in range(11):
                    out[k, r, c] = np.nan
