"""The audit of the split: the ground of each part, and how much of it another part shares (which should be none)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas import CROPS, SPLITS, open_artefact
from stages.physics.maps.grid import Grid
from stages.physics.maps.ground_tiles import Tiles
from stages.physics.maps.positions import blocks


@dataclass(frozen=True)
class Part:
    """One part of the split: how much it holds, and how much of its ground another part has as well."""

    name: str
    pairs: int
    images: int
    tiles: int
    ground_km2: float
    shared_km2: float


def audit(chosen: NDArray, tiles: Tiles, grid: Grid, crop: int) -> list[Part]:
    """Count pairs, images, tiles and ground per part, and the ground that a part shares with another.

    chosen : (n,) of places.CHOSEN, the crops' centres; crop : px
    """
    size = max(2048, 4 * crop)
    half = crop // 2
    ground, shared = np.zeros(3), np.zeros(3)
    for row, col, h, w in blocks(grid.height, grid.width, size):
        near = (
            (chosen["row"] + half > row)
            & (chosen["row"] - half < row + h)
            & (chosen["col"] + half > col)
            & (chosen["col"] - half < col + w)
        )
        if not near.any():
            continue
        painted = np.zeros((h, w), np.uint8)
        for r, c, k in zip(chosen["row"][near], chosen["col"][near], chosen["split"][near], strict=True):
            painted[
                max(0, r - half - row) : max(0, r + half - row), max(0, c - half - col) : max(0, c + half - col)
            ] |= 1 << k
        pixel = float(np.prod(grid.local_frames(row + h / 2, col + w / 2).pixel_size[0])) / 1e6
        for k in range(3):
            mine = (painted & (1 << k)) > 0
            ground[k] += mine.sum() * pixel
            shared[k] += (mine & (painted != (1 << k))).sum() * pixel
    return [
        Part(
            name,
            int((chosen["split"] == k).sum()),
            len(np.unique(chosen["frame"][chosen["split"] == k])),
            int((tiles.part == k).sum()),
            float(ground[k]),
            float(shared[k]),
        )
        for name, k in SPLITS
    ]


def read_audit(crops: Path) -> list[Part]:
    """The audit that a file holds, which is that of all shards."""
    with open_artefact(crops, CROPS) as file:
        return [Part(**part) for part in json.loads(file.attrs["split_audit"])]
