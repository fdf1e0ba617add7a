"""The geographic split of a scene: square ground tiles, dealt to training, validation and test by a hash.

It depends on the scene, `tile_m`, `split` and `seed` only, not on what is sampled: see `stages/sample`.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

import cv2
import h5py
import numpy as np
from geographiclib.geodesic import Geodesic
from numpy.typing import NDArray

from schemas import ConfigError
from stages.common.progress import Progress
from stages.physics.maps.grid import Grid
from stages.physics.maps.positions import blocks, valid_positions

TEST_TILES = 20  # aimed at without `tile_m`: confidence intervals over fewer are wide
WITH_ROOM = 0.8  # expected share of tiles in which a crop fits: images end, elevations have holes
SMALLEST_TILE, LARGEST_TILE = 1.125, 4  # of the scene's crops


@dataclass(frozen=True)
class Tiles:
    """Square ground tiles from the scene grid's first pixel on: ``edge`` in pixels; ``part`` (rows, cols) int8, -1 where unused."""

    edge: int
    part: NDArray[np.int8]

    def identity(self, ground_deg: tuple[float, float, float, float]) -> dict[str, Any]:
        """Identity of the split, kept in ``config`` of all that is made from it, so that two samples can be compared.

        ground_deg : west, east, south, north
        """
        digest = hashlib.sha256(json.dumps([self.edge, self.part.shape, ground_deg]).encode() + self.part.tobytes())
        return {"split_id": digest.hexdigest()[:16], "split_ground_deg": ground_deg}

    def allowed(self, row: NDArray, col: NDArray, crop: int) -> NDArray[np.int8]:
        """(n, m) part of the split of crops centred at row (n, 1) and col (m,), -1 where none may be.

        A crop may not touch two parts, nor two tiles unless it is for training.
        """
        half = crop // 2
        r0, r1 = (row - half) // self.edge, (row + half - 1) // self.edge
        c0, c1 = (col - half) // self.edge, (col + half - 1) // self.edge
        rows, cols = self.part.shape
        # Centres near the scene's edge have no whole footprint and are not valid positions anyway.
        r0, r1 = (np.clip(r, 0, rows - 1) for r in (r0, r1))
        c0, c1 = (np.clip(c, 0, cols - 1) for c in (c0, c1))
        corner = self.part[r0, c0]
        same = (corner == self.part[r0, c1]) & (corner == self.part[r1, c0]) & (corner == self.part[r1, c1])
        one_tile = (r0 == r1) & (c0 == c1)
        return np.where(same & (one_tile | (corner == 0)), corner, -1).astype(np.int8)


class PositionMasks:
    """Valid positions of a scene, block by block, for any crop size."""

    def __init__(self, file: h5py.File, grid: Grid, crop: int, block: int) -> None:
        self.file, self.grid, self.crop = file, grid, crop
        self.scene_crop = int(file.attrs["crop_px"])
        self.windows = file["frame_window"][...]
        self.blocks = list(blocks(grid.height, grid.width, block))

    def frames_of(self, block: tuple[int, int, int, int]) -> list[int]:
        """Frames whose valid pixels meet a block."""
        row, col, h, w = block
        r, c, fh, fw = self.windows.T
        meets = (fh > 0) & (r < row + h) & (r + fh > row) & (c < col + w) & (c + fw > col)
        return [int(k) for k in np.flatnonzero(meets)]

    def mask(self, frame: int, block: tuple[int, int, int, int], crop: int | None = None) -> NDArray[np.bool_]:
        """(height, width) bool: where a crop of an image may be centred; block : row, column, height, width; crop : px"""
        # Two-dimensional view of one frame, sliced lazily.
        layer = _Layer(self.file["valid"], frame)
        return valid_positions(layer, self.grid.height, self.grid.width, block, crop or self.crop)

    def largest_square(self) -> int:
        """px, side of the largest square of valid ground that an image shows, of those smaller than a crop."""
        largest = 0
        for k, (row, col, height, width) in enumerate(self.windows.tolist()):
            for top in range(row, row + height, 4 * self.crop):
                strip = self.file["valid"][k, top : min(top + 5 * self.crop, row + height), col : col + width]
                reach = cv2.distanceTransform(np.pad(strip, 1), cv2.DIST_C, 3).max(initial=0)
                largest = max(largest, 2 * int(reach) - 1)
        return largest


class _Layer:
    """One frame of a (frame, y, x) dataset that slices like a two-dimensional one."""

    def __init__(self, data: h5py.Dataset, index: int) -> None:
        self.data, self.index = data, index

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray:
        return self.data[(self.index, *key)]


def tile_edge(grid: Grid, positions: PositionMasks, shares: tuple[float, float, float], tile_m: float | None) -> int:
    """Edge of a ground tile in pixels; metres are measured along the body with a geodesic at the scene's centre.

    Without `tile_m` it follows from the scene and the shares alone, not from the crops that are asked for.
    """
    crop = positions.crop
    if tile_m is not None:
        row, col = grid.height / 2, grid.width / 2
        lon, lat = grid.lonlat([row, row], [col - 50, col + 50])
        metres = Geodesic(grid.radius, 0).Inverse(lat[0], lon[0], lat[1], lon[1])["s12"] / 100
        edge = min(round(tile_m / metres), 4 * max(grid.height, grid.width))
        if edge < crop:
            raise ConfigError(f"`tile_m`: expected at least one crop ({crop * metres:g} m), found {tile_m:g} m.")
        return edge
    edge = _scene_edge(positions, shares)
    if edge < crop:
        raise ConfigError(
            f"`crop`: expected at most {edge} px, the ground tiles of this scene's split, found {crop}; "
            "name larger tiles with `tile_m` here and wherever else this scene is sampled."
        )
    return edge


def _scene_edge(positions: PositionMasks, shares: tuple[float, float, float]) -> int:
    """px, leaves TEST_TILES for testing, between SMALLEST_TILE and LARGEST_TILE; no slivers at the border."""
    crop, used = positions.scene_crop, positions.windows[positions.windows[:, 2] > 0]
    if not len(used):
        return LARGEST_TILE * crop
    height = int((used[:, 0] + used[:, 2]).max() - used[:, 0].min())
    width = int((used[:, 1] + used[:, 3]).max() - used[:, 1].min())
    tiles = TEST_TILES / min(s for s in shares if s > 0) / WITH_ROOM
    edge = min(max(math.sqrt(height * width / tiles), SMALLEST_TILE * crop), LARGEST_TILE * crop)
    longest = max(height, width)
    return math.ceil(longest / max(1, math.floor(longest / edge)))


def split_tiles(
    positions: PositionMasks,
    grid: Grid,
    edge: int,
    split: tuple[float, float, float],
    seed: int,
    progress: Progress,
) -> Tiles:
    """Give every tile with valid ground to a part, in the order of a hash, so that the parts' ground is near their shares.

    Tiles in which no crop of the scene's own size fits are for training only.
    """
    shape = (math.ceil(grid.height / edge), math.ceil(grid.width / edge))
    ground, room = np.zeros(shape), np.zeros(shape, bool)
    before, behind = positions.scene_crop // 2, positions.scene_crop - positions.scene_crop // 2 - 1
    for number, block in enumerate(positions.blocks):
        progress(number, len(positions.blocks), "tiles")
        row, col, h, w = block
        part_of_scene = np.s_[row : row + h, col : col + w]
        covered, centres = np.zeros((h, w), bool), np.zeros((h, w), bool)
        for frame in positions.frames_of(block):
            covered |= positions.file["valid"][frame, *part_of_scene].astype(bool)
            centres |= positions.mask(frame, block, positions.scene_crop)
        r, c = np.nonzero(covered)
        np.add.at(ground, ((r + row) // edge, (c + col) // edge), 1)
        r, c = (v + first for v, first in zip(np.nonzero(centres), (row, col), strict=True))
        inside = ((r - before) // edge == (r + behind) // edge) & ((c - before) // edge == (c + behind) // edge)
        room[r[inside] // edge, c[inside] // edge] = True
    progress(len(positions.blocks), len(positions.blocks), "tiles")
    if not room.any():  # the tiles are smaller than the scene's crops: smaller crops will be sampled
        room = ground > 0
    part = np.where(ground > 0, 0 if split[0] > 0 else -1, -1).astype(np.int8)
    shares = np.array(split)
    total, filled = (ground * room).sum(), np.zeros(3)
    for row, col in sorted(np.argwhere(room).tolist(), key=lambda at: _lot(seed, *at)):
        deficit = shares * total - filled
        deficit[shares <= 0] = -np.inf
        # The emptiest part relative to its share: small parts get their first tile early.
        k = int(np.argmax(deficit / np.maximum(shares * total, 1)))
        part[row, col] = k
        filled[k] += ground[row, col]
    return Tiles(edge, part)


def _lot(seed: int, row: int, col: int) -> bytes:
    """Sort key of a tile in the draw, from its index and the seed alone: the same with every version of numpy."""
    return hashlib.sha256(f"{seed} {row} {col}".encode()).digest()


def bounds_deg(grid: Grid) -> tuple[float, float, float, float]:
    """West, east, south, north of the scene, degrees to 1e-5."""
    rows, cols = np.linspace(0, grid.height, 9), np.linspace(0, grid.width, 9)
    lon, lat = grid.lonlat(*(v.ravel() for v in np.meshgrid(rows, cols, indexing="ij")))
    middle = grid.lonlat([grid.height / 2], [grid.width / 2])[0][0]
    lon = middle + (np.asarray(lon) - middle + 180) % 360 - 180
    west, east, south, north = (round(float(v), 5) for v in (lon.min(), lon.max(), np.min(lat), np.max(lat)))
    return west, east, south, north
