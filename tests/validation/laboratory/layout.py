"""How many sites, images and pixels a case has, and what a planted effect needs of its world to be there at all."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .fields import Array

TRAIN, VALIDATION, TEST = 0, 1, 2
EDGE = 64  # px of terrain around the outermost sites: it throws shadows into them
GAP = 28  # px between crops


@dataclass(frozen=True)
class Layout:
    """Numbers of a case; images None: four to six, drawn. `shared`: every image shows every site."""

    sites: int
    images: int | None
    size: int
    train: int
    validation: int
    test: int
    shared: bool = True


LAYOUTS = {
    "a": Layout(sites=5, images=12, size=96, train=3, validation=1, test=1),
    "b": Layout(sites=4, images=8, size=128, train=3, validation=0, test=1),
    "c": Layout(sites=24, images=8, size=96, train=16, validation=3, test=5, shared=False),
    "d": Layout(sites=8, images=None, size=96, train=5, validation=1, test=2),
}


@dataclass(frozen=True)
class Needs:
    """What a plant asks of its world. None: left to chance."""

    steep: bool = False
    low_sun: bool = False
    oblique: bool | None = None
    oblique_share: float | None = None  # chance of oblique views, where it is not the usual one
    margin: int = 12  # px rendered around a crop
    line_scan: bool | None = None
    bright_law: bool = False
    no_hapke: bool = False
    no_albedo_border: bool = False


@dataclass
class Sites:
    """Where the crops lie on the scene grid of `grid` x `grid` pixels."""

    name: str
    layout: Layout
    images: int
    grid: int
    row: np.ndarray  # (sites,), of the corner in the middle of each crop
    col: np.ndarray

    @property
    def size(self) -> int:
        return self.layout.size

    @property
    def split(self) -> np.ndarray:
        """(sites,): which part of the geographic split."""
        layout = self.layout
        return np.array([TRAIN] * layout.train + [VALIDATION] * layout.validation + [TEST] * layout.test)

    def pairs(self) -> list[tuple[int, int]]:
        """(site, image) of every pair."""
        if not self.layout.shared:
            return [(site, site % self.images) for site in range(self.layout.sites)]
        return [(site, image) for site in range(self.layout.sites) for image in range(self.images)]

    def crop(self, grid: Array, site: int) -> Array:
        """(size, size) of a scene grid of pixels."""
        half = self.size // 2
        row, col = self.row[site], self.col[site]
        return grid[row - half : row + half, col - half : col + half]

    def crops(self, grid: Array) -> Array:
        """(sites, size, size)."""
        return np.array([self.crop(grid, site) for site in range(self.layout.sites)])


def draw_sites(rng: np.random.Generator, name: str, images: int) -> Sites:
    layout = LAYOUTS[name]
    cols = math.ceil(math.sqrt(layout.sites))
    rows = math.ceil(layout.sites / cols)
    pitch = layout.size + GAP
    cells = [(a, b) for a in range(rows) for b in range(cols)]
    cells = [cells[q] for q in rng.permutation(len(cells))[: layout.sites]]
    first = EDGE + GAP // 2 + layout.size // 2
    row = np.array([first + a * pitch + int(rng.integers(-8, 9)) for a, _ in cells])
    col = np.array([first + b * pitch + int(rng.integers(-8, 9)) for _, b in cells])
    return Sites(name, layout, images, max(cols, rows) * pitch + 2 * EDGE, row, col)
