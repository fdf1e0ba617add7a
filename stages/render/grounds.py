"""The ground that views need: windows of a surface made ready for rays, averaged or refined, kept between views."""

from __future__ import annotations

import dataclasses
import math
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from rasterio.transform import Affine

from stages.common.arrays import Floats, Floats32
from stages.physics.horizon.scene import Overview, SceneTerrain, make_overview
from stages.physics.maps.grid import Grid
from stages.physics.maps.window import Window
from stages.physics.relief.detail import Detail
from stages.physics.terrain.further_light import Horizon
from stages.physics.terrain.shading import Light
from stages.physics.terrain.sun import Sun
from stages.physics.terrain.surface import Surface
from stages.render.raycast import HeightField, Hits, build_height_field

LARGEST_GROUND = 1 << 25  # pixels of a surface that are kept for later views, for each of MOST_GROUNDS resolutions
LARGEST_REFINED = 1 << 22  # pixels of refined ground
MOST_GROUNDS = 8
OVERVIEW_PX = 4096  # a side: refined ground looks for far horizons on this
NEAR_POSTS, NEAR_PX = 4, 256  # DEM pixels and refined ones, from which on the DEM alone casts shadows


@dataclass(frozen=True)
class Ground:
    """A window of a surface at the resolution that an image's pixels need: all that depends on no Sun and no camera.

    factor : pixels of the surface along one of ``grid``; finer : pixels of ``grid`` along one of the surface (one of both is 1)
    maps : (C, h, w) coefficients or (C, 1, 1), on the surface's pixels where these are refined
    horizons : towards each Sun, (h, w), rad; kept as long as the Sun's own horizon is
    """

    window: Window
    factor: int
    finer: int
    grid: Grid
    field: HeightField
    maps: Floats32
    refined: Refined | None = None
    horizons: WeakKeyDictionary[Horizon, Floats32] = dataclasses.field(default_factory=WeakKeyDictionary)

    def horizon(self, light: Light) -> Floats32 | None:
        """(h, w), rad; None where nothing casts shadows."""
        towards = light.horizon
        if towards is not None and towards not in self.horizons:
            found = (
                self.refined.horizon(self.window, self.finer, light.sun)
                if self.refined
                else towards.window(*self.window)
            )
            self.horizons[towards] = self.coarse(found)
        return None if towards is None else self.horizons[towards]

    def coarse(self, values: Floats32) -> Floats32:
        """(..., h, w) on ``grid`` from values on the window's own pixels."""
        return values if self.factor == 1 else coarsen(values, self.factor)

    def on_surface(self, hits: Hits) -> tuple[Floats, Floats]:
        """Rows and columns of hits on refined or unchanged ground, counted on the whole surface."""
        row, col = ((v + 0.5) / self.finer - 0.5 for v in (hits.row, hits.col))
        return row + self.window.row, col + self.window.col

    def holds(self, row: Floats, col: Floats) -> NDArray[np.bool_]:
        """Which places on the surface, (n,) px, lie between the pixel centres of the window."""
        down, right = row - self.window.row, col - self.window.col
        return (down >= 0) & (right >= 0) & (down <= self.window.height - 1) & (right <= self.window.width - 1)


class Refined:
    """A surface with invented detail below its pixels, and the horizon that it has."""

    def __init__(self, surface: Surface, detail: Detail) -> None:
        self._surface, self._detail = surface, detail

    def grid(self, window: Window, finer: int) -> Grid:
        """Of a window of the surface at ``finer`` x ``finer`` pixels to one."""
        piece = self._surface.grid.window(*window)
        transform = piece.transform @ Affine.scale(1 / finer)
        return Grid(piece.crs_wkt, transform, piece.height * finer, piece.width * finer, piece.radius)

    def heights(self, window: Window, finer: int) -> Floats32:
        """(h finer, w finer) m."""
        return self._detail.heights(window, finer)

    @cached_property
    def _overview(self) -> Overview:
        shape = self._surface.elevation.shape
        return make_overview(self._surface.elevation, max(1, math.ceil(max(shape) / OVERVIEW_PX)))

    def horizon(self, window: Window, finer: int, sun: Sun) -> Floats32:
        """(h finer, w finer) rad, towards the Sun: of refined terrain near by, of the DEM farther off."""
        far = self._overview
        near = max(NEAR_PX, finer * (NEAR_POSTS if far.factor == 1 else 16 * far.factor))
        shape = (far.shape[0] * finer, far.shape[1] * finer)
        overview = dataclasses.replace(far, factor=far.factor * finer, shape=shape, near_px=near)
        whole = Window(0, 0, *far.shape)
        terrain = SceneTerrain(_Slices(self, shape, finer), self.grid(whole, finer), overview)
        azimuth, elevation = sun.over(self._surface.grid, window.row + window.height / 2, window.col + window.width / 2)
        return terrain.horizon(Window(*(n * finer for n in window)), azimuth, elevation)


@dataclass(frozen=True)
class _Slices:
    """Refined heights as an array that is sliced; shape : of all of it."""

    refined: Refined
    shape: tuple[int, int]
    finer: int

    def __getitem__(self, key: tuple[slice, slice]) -> Floats32:
        rows, cols = (s.indices(n) for s, n in zip(key, self.shape, strict=True))
        first = [edge[0] // self.finer for edge in (rows, cols)]
        last = [-(-edge[1] // self.finer) for edge in (rows, cols)]
        window = Window(first[0], first[1], last[0] - first[0], last[1] - first[1])
        heights = self.refined.heights(window, self.finer)
        top, left = (edge[0] - start * self.finer for edge, start in zip((rows, cols), first, strict=True))
        return heights[top : top + rows[1] - rows[0], left : left + cols[1] - cols[0]]


class Grounds:
    """The grounds of a surface that views have seen, one for each resolution, grown to hold all of them up to a largest size."""

    def __init__(self, surface: Surface, detail: Detail | None = None) -> None:
        self.surface = surface
        self.refined = None if detail is None else Refined(surface, detail)
        self._kept: OrderedDict[tuple[int, int], Ground] = OrderedDict()

    def over(self, window: Window, factor: int = 1, finer: int = 1) -> Ground:
        """A ground that holds ``window``, at blocks of ``factor`` x ``factor`` pixels, or ``finer`` x ``finer`` pixels to one. Raises GeometryError."""
        kept = self._kept.pop((factor, finer), None)
        if kept is None or kept.window.union(window) != kept.window:
            whole = window if kept is None else kept.window.union(window)
            largest = LARGEST_GROUND if finer == 1 else LARGEST_REFINED // finer**2
            whole = whole if whole.height * whole.width <= largest else window
            kept = self._make(whole, factor, finer)
        self._kept[factor, finer] = kept
        while len(self._kept) > MOST_GROUNDS:
            self._kept.popitem(last=False)
        return kept

    def _make(self, window: Window, factor: int, finer: int) -> Ground:
        """Read a window and prepare it for rays. Raises GeometryError."""
        surface, refined = self.surface, self.refined if finer > 1 else None
        maps, grid = surface.read_coefficients(*window), surface.grid.window(*window)
        if refined is not None:
            elevation, grid = refined.heights(window, finer), refined.grid(window, finer)
        else:
            elevation = surface.elevation[window.part]
        if factor > 1:
            elevation = coarsen(elevation, factor)
            maps = coarsen(maps, factor) if maps.shape[1] > 1 else maps
            transform = grid.transform @ Affine.scale(factor)
            grid = Grid(grid.crs_wkt, transform, elevation.shape[0], elevation.shape[1], grid.radius)
        return Ground(window, factor, finer, grid, build_height_field(elevation, grid), maps, refined)


def coarsen(values: Floats32, factor: int) -> Floats32:
    """Means of whole factor x factor blocks, over what is known (NaN where nothing is).

    values : (..., H, W); returns (..., H // factor, W // factor)
    """
    height, width = (n // factor for n in values.shape[-2:])
    blocks = values[..., : height * factor, : width * factor].reshape(*values.shape[:-2], height, factor, width, factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=(-3, -1))
    total = np.where(known, blocks, 0).sum(axis=(-3, -1), dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (total / count).astype(np.float32)
