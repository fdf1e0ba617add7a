"""Source images on a scene's grid, read alike whether they are map-projected or as a camera took them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.windows import Window

from stages.common.arrays import Floats
from stages.physics.bodies.spheres import find_body
from stages.physics.cameras import Camera
from stages.physics.images.area_means import area_means
from stages.physics.images.camera_image import CameraImage, open_camera_image
from stages.physics.images.displacement import Field, Relief, relief_displacement
from stages.physics.images.frame_geometry import open_camera_for
from stages.physics.images.orthorectify import (
    Displacement,
    Ortho,
    Terrain,
    bilinear,
    footprint,
    orthorectify,
    reach_px,
)
from stages.physics.images.table import Frame
from stages.physics.maps import rasters
from stages.physics.maps.grid import Grid, require_crs, unit_vectors
from stages.physics.maps.window import Box

FARTHEST_EDGE = math.radians(60)  # an image whose edge lies farther from a grid's middle may surround the grid


@dataclass(frozen=True)
class Pixels:
    """A window of an image on the scene's grid.

    values : (h, w) float32, NaN where not seen; valid : (h, w) bool; ortho : None for map-projected images
    """

    values: NDArray[np.float32]
    valid: NDArray[np.bool_]
    ortho: Ortho | None


class Source(Protocol):
    """An image whose pixels can be read onto the grid of a scene."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What its camera took otherwise than the camera's file says."""

    def box(self) -> Box | None:
        """(row, col, height, width) on the grid that holds all that the image shows, None where it lies elsewhere."""

    def read(self, row: int, col: int, height: int, width: int, field: Field | None = None) -> Pixels:
        """The image on a window of the grid, corrected by the displacement ``field`` that registration found."""

    def relief(self, reference: float) -> Relief | None:
        """Relief displacement if projected onto the sphere at ``reference`` m; None where the terrain was followed."""


@contextlib.contextmanager
def open_source(frame: Frame, grid: Grid, elevation: Any, heights: tuple[float, float]) -> Iterator[Source]:
    """Open the image of a frame. Raises LunargrError for images and cameras that cannot be used.

    elevation : (H, W) array or dataset on ``grid``, m, NaN = unknown; heights : its least and largest value
    """
    what = f"the image '{frame.image_id}'"
    if frame.camera is None:
        with rasters.open_raster(frame.path, what) as dataset:
            require_crs(str(frame.path), dataset.crs, dataset.transform, find_body(str(grid.radius)))
            band = rasters.choose_band(frame.path, dataset, frame.band, what)
            yield MapSource(dataset, grid, elevation, frame.camera_position(grid.radius), band)
        return
    camera = open_camera_for(frame.camera, grid.radius)
    with open_camera_image(frame.path, camera, what, frame.band) as image:
        yield CameraSource(image, camera, elevation, grid, heights, frame.sun_position())


@dataclass(frozen=True)
class MapSource:
    """A map-projected image, which may have been projected onto the terrain or onto the sphere.

    elevation : (H, W) array or dataset on ``grid``, m; camera_position : (3,) body-fixed, m
    """

    dataset: DatasetReader
    grid: Grid
    elevation: Any
    camera_position: Floats
    band: int = 1
    notes: tuple[str, ...] = ()

    @cached_property
    def _placements(self) -> list[tuple[float, Window]]:
        return rasters.placements(self.dataset, self.grid, margin=0)

    def box(self) -> Box | None:
        """See :meth:`Source.box`."""
        if not self._placements:
            return None
        image, grid = self.dataset, self.grid
        own = rasters.grid_of(image, grid.radius)
        down, right = np.linspace(-0.5, image.height - 0.5, 33), np.linspace(-0.5, image.width - 0.5, 33)
        top, left = np.full(33, -0.5), np.full(33, -0.5)
        rows = np.concatenate([down, down, top, np.full(33, image.height - 0.5)])
        cols = np.concatenate([left, np.full(33, image.width - 0.5), right, right])
        lon, lat = own.lonlat(rows, cols)
        up = unit_vectors(*grid.lonlat((grid.height - 1) / 2, (grid.width - 1) / 2))
        if (unit_vectors(lon, lat) @ up).min() < math.cos(FARTHEST_EDGE):
            return 0, 0, grid.height, grid.width
        row, col = grid.rowcol_of_lonlat(lon, lat)
        good = np.isfinite(row) & np.isfinite(col)
        r0, c0 = max(0, math.floor(row[good].min())), max(0, math.floor(col[good].min()))
        r1 = min(grid.height, math.ceil(row[good].max()) + 1)
        c1 = min(grid.width, math.ceil(col[good].max()) + 1)
        return r0, c0, max(0, r1 - r0), max(0, c1 - c0)

    def read(self, row: int, col: int, height: int, width: int, field: Field | None = None) -> Pixels:
        """See :meth:`Source.read`; resampled from one map to the other."""
        if field is None or field.refused:
            part = self.grid.window(row, col, height, width)
            return Pixels(
                *rasters.warp(self.dataset, part, rasters.choose_resampling(self.dataset, part)[0], self.band), None
            )
        return Pixels(*self._read_moved(row, col, height, width, field), None)

    def relief(self, reference: float) -> Relief | None:
        """See :meth:`Source.relief`."""
        return relief_displacement(self.grid, self.camera_position, reference)

    def _read_moved(
        self, row: int, col: int, height: int, width: int, field: Field
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Area means over the patches of the image that show the pixels, by the places of their corners."""
        r, c = np.meshgrid(np.arange(height + 1) + row - 0.5, np.arange(width + 1) + col - 0.5, indexing="ij")
        relief = self._relief_at(r, c, field.reference) if field.share else None
        dx, dy = field.at(r, c, relief)
        lon, lat = self.grid.lonlat(r + dy, c + dx)
        own = rasters.grid_of(self.dataset, self.grid.radius)
        values, valid = np.full((height, width), np.nan, np.float32), np.zeros((height, width), bool)
        for middle, _ in self._placements:
            sample, line = ~self.dataset.transform @ own.map_xy(lon, lat, middle)
            lines, samples = sliding_window_view(line, (2, 2)), sliding_window_view(sample, (2, 2))
            more, more_valid = area_means(self._pixels, self.dataset.shape, lines, samples, ~valid)
            values[more_valid], valid[more_valid] = more[more_valid], True
        return values, valid

    def _relief_at(self, row: Floats, col: Floats, reference: float) -> tuple[Floats, Floats]:
        """(dx, dy) px of all the relief displacement at places in a window; unknown ground counts as level."""
        r0, c0 = max(0, math.floor(row.min())), max(0, math.floor(col.min()))
        piece = np.asarray(
            self.elevation[r0 : math.ceil(row.max()) + 2, c0 : math.ceil(col.max()) + 2], dtype=np.float64
        )
        height = bilinear(piece, row - r0, col - c0)
        return relief_displacement(self.grid, self.camera_position, reference)(
            row, col, np.where(np.isfinite(height), height, reference)
        )

    def _pixels(self, line: int, sample: int, lines: int, samples: int) -> NDArray[np.float32]:
        return rasters.read_window(self.dataset, Window(sample, line, samples, lines), self.band).astype(np.float32)


@dataclass(frozen=True)
class CameraSource:
    """An image as its camera took it, orthorectified with the scene's terrain.

    elevation : (H, W) array or dataset on ``grid``, m; heights : its least and largest value
    sun_position : (3,) body-fixed, m
    """

    image: CameraImage
    camera: Camera
    elevation: Any
    grid: Grid
    heights: tuple[float, float]
    sun_position: Floats

    @property
    def notes(self) -> tuple[str, ...]:
        """See :attr:`Source.notes`."""
        return self.camera.notes

    def box(self) -> Box | None:
        """See :meth:`Source.box`."""
        return footprint(self.camera, self.grid, self.heights)

    def relief(self, reference: float) -> Relief | None:
        """None: orthorectification follows the terrain."""
        return None

    def read(self, row: int, col: int, height: int, width: int, field: Field | None = None) -> Pixels:
        """See :meth:`Source.read`; orthorectified with the scene's elevations."""
        r0, c0, r1, c1 = self._surroundings(row, col, height, width)
        piece = np.asarray(self.elevation[r0:r1, c0:c1], dtype=float)
        terrain = Terrain(piece, self.grid.window(r0, c0, r1 - r0, c1 - c0))
        displacement: Displacement | None = None
        if field is not None and field.accepted:

            def displacement(r: NDArray, c: NDArray) -> tuple[NDArray, NDArray]:
                return field.at(r + r0, c + c0)

        box = (row - r0, col - c0, height, width)
        ortho = orthorectify(self.image.read, self.camera, terrain, box, self.sun_position, displacement)
        return Pixels(ortho.image, ortho.valid, ortho)

    def _surroundings(self, row: int, col: int, height: int, width: int) -> tuple[int, int, int, int]:
        """First and last row and column of the box and of the terrain towards the camera that can hide it."""
        rows, cols = self.grid.height, self.grid.width
        inside = np.asarray(self.elevation[row : row + height, col : col + width], dtype=float)
        known = inside[np.isfinite(inside)]
        lowest = float(known.min()) if known.size else self.heights[1]
        middle = row + (height - 1) / 2, col + (width - 1) / 2
        axes = self.grid.local_frames(*middle).axes[0]
        centre = axes[2] * (self.grid.radius + lowest)
        line, sample = self.camera.ground_to_image(centre)
        at = float(line) if np.isfinite(line) else self.camera.lines / 2
        across = float(sample) if np.isfinite(sample) else self.camera.samples / 2
        _, direction = self.camera.rays(at, across)
        east, north, up = axes @ -direction
        emission = math.acos(max(-1.0, min(1.0, float(up))))
        reach = reach_px(max(0.0, self.heights[1] - lowest), emission, self.grid.gsd)
        level = math.hypot(east, north) or 1.0
        # the azimuth varies a little over the box: one eighth of the reach to the sides
        side = math.ceil(reach / 8) + 2
        towards_row, towards_col = -north / level * reach, east / level * reach
        r0 = row + min(0, math.floor(towards_row)) - side
        r1 = row + height + max(0, math.ceil(towards_row)) + side
        c0 = col + min(0, math.floor(towards_col)) - side
        c1 = col + width + max(0, math.ceil(towards_col)) + side
        return max(0, r0), max(0, c0), min(rows, r1), min(cols, c1)
