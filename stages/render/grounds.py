"""The ground that views need: windows of a surface made ready for rays, kept between views."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from rasterio.transform import Affine

from stages.common.arrays import Floats32
from stages.physics.maps.grid import Grid
from stages.physics.maps.window import Window
from stages.physics.terrain.further_light import Horizon
from stages.physics.terrain.surface import Surface
from stages.render.raycast import HeightField, build_height_field

LARGEST_GROUND = 1 << 25  # pixels of a surface that are kept for later views, for each of MOST_GROUNDS resolutions
MOST_GROUNDS = 3


@dataclass(frozen=True)
class Ground:
    """A window of a surface at the resolution that an image's pixels need: all that depends on no Sun and no camera.

    factor : pixels of the surface along one of ``grid``; maps : (C, h, w) coefficients or (C, 1, 1)
    horizons : towards each Sun, (h, w), rad; kept as long as the Sun's own horizon is
    """

    window: Window
    factor: int
    grid: Grid
    field: HeightField
    maps: Floats32
    horizons: WeakKeyDictionary[Horizon, Floats32] = dataclasses.field(default_factory=WeakKeyDictionary)

    def horizon(self, towards: Horizon | None) -> Floats32 | None:
        """(h, w), rad; None where nothing casts shadows."""
        if towards is not None and towards not in self.horizons:
            self.horizons[towards] = self.coarse(towards.window(*self.window))
        return None if towards is None else self.horizons[towards]

    def coarse(self, values: Floats32) -> Floats32:
        """(..., h, w) on ``grid`` from values on the window's own pixels."""
        return values if self.factor == 1 else coarsen(values, self.factor)


class Grounds:
    """The grounds of a surface that views have seen, one for each resolution, grown to hold all of them up to LARGEST_GROUND pixels."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._kept: OrderedDict[int, Ground] = OrderedDict()

    def over(self, window: Window, factor: int) -> Ground:
        """A ground that holds ``window``, at blocks of ``factor`` x ``factor`` pixels. Raises GeometryError."""
        kept = self._kept.pop(factor, None)
        if kept is None or kept.window.union(window) != kept.window:
            whole = window if kept is None else kept.window.union(window)
            kept = make_ground(self._surface, whole if whole.height * whole.width <= LARGEST_GROUND else window, factor)
        self._kept[factor] = kept
        while len(self._kept) > MOST_GROUNDS:
            self._kept.popitem(last=False)
        return kept


def make_ground(surface: Surface, window: Window, factor: int) -> Ground:
    """Read a window and prepare it for rays. Raises GeometryError."""
    elevation, maps = surface.elevation[window.part], surface.read_coefficients(*window)
    grid = surface.grid.window(*window)
    if factor > 1:
        elevation = coarsen(elevation, factor)
        maps = coarsen(maps, factor) if maps.shape[1] > 1 else maps
        transform = grid.transform @ Affine.scale(factor)
        grid = Grid(grid.crs_wkt, transform, elevation.shape[0], elevation.shape[1], grid.radius)
    return Ground(window, factor, grid, build_height_field(elevation, grid), maps)


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
