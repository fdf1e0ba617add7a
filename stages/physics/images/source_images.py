"""Source images on a scene's grid, whether map-projected or as a camera took them: one way to ask for a window."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.transform import Affine

from stages.physics.bodies.spheres import find_body
from stages.physics.cameras import Camera
from stages.physics.images.camera_image import CameraImage, open_camera_image
from stages.physics.images.frame_geometry import open_camera_for
from stages.physics.images.orthorectify import Displacement, Ortho, Terrain, footprint, orthorectify, reach_px
from stages.physics.images.registration import Field
from stages.physics.images.table import Frame
from stages.physics.maps import rasters
from stages.physics.maps.grid import GDAL_CENTRE, Grid, check_body, require_crs

Floats = NDArray[np.float64]
Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class Pixels:
    """A window of the scene's grid. values : (h, w) float32, NaN where not seen; valid : (h, w) bool;
    ortho : the camera's side of it, None for map-projected images."""

    values: NDArray[np.float32]
    valid: NDArray[np.bool_]
    ortho: Ortho | None


class Source(Protocol):
    def box(self) -> Box | None:
        """(row, col, height, width) on the grid that holds all that the image shows, None where it lies elsewhere."""

    def read(self, row: int, col: int, height: int, width: int, field: Field | None = None) -> Pixels:
        """The image on a window of the grid, moved by what registration found."""


@contextlib.contextmanager
def open_source(frame: Frame, grid: Grid, elevation: Any, heights: tuple[float, float]) -> Iterator[Source]:
    """Open the image of a frame. Raises LunargrError for images and cameras that cannot be used.

    elevation : (H, W) array or dataset on ``grid``, m, NaN = unknown; heights : its least and largest value
    """
    what = f"the image '{frame.image_id}'"
    if frame.camera is None:
        with rasters.open_raster(frame.path, what) as dataset:
            require_crs(str(frame.path), dataset.crs, dataset.transform)
            check_body(str(frame.path), dataset.crs, find_body(str(grid.radius)))
            yield MapSource(dataset, grid)
        return
    camera = open_camera_for(frame.camera, grid.radius)
    with open_camera_image(frame.path, camera, what) as image:
        yield CameraSource(image, camera, elevation, grid, heights, frame.sun_position())


@dataclass(frozen=True)
class MapSource:
    """A map-projected image."""

    dataset: DatasetReader
    grid: Grid

    def box(self) -> Box | None:
        if rasters.source_window(self.dataset, self.grid, margin=0) is None:
            return None
        image = self.dataset
        own = Grid(image.crs.to_wkt(), image.transform, image.height, image.width, self.grid.radius)
        down, right = np.linspace(-0.5, image.height - 0.5, 33), np.linspace(-0.5, image.width - 0.5, 33)
        top, left = np.full(33, -0.5), np.full(33, -0.5)
        rows = np.concatenate([down, down, top, np.full(33, image.height - 0.5)])
        cols = np.concatenate([left, np.full(33, image.width - 0.5), right, right])
        row, col = self.grid.rowcol_of_lonlat(*own.lonlat(rows, cols))
        good = np.isfinite(row) & np.isfinite(col)
        r0, c0 = max(0, math.floor(row[good].min())), max(0, math.floor(col[good].min()))
        r1 = min(self.grid.height, math.ceil(row[good].max()) + 1)
        c1 = min(self.grid.width, math.ceil(col[good].max()) + 1)
        return r0, c0, max(0, r1 - r0), max(0, c1 - c0)

    def read(self, row: int, col: int, height: int, width: int, field: Field | None = None) -> Pixels:
        part = self.grid.window(row, col, height, width)
        resampling = rasters.choose_resampling(self.dataset, part)[0]
        if field is not None and field.accepted:
            part = _moved(part, row, col, field)
        return Pixels(*rasters.warp(self.dataset, part, resampling), None)


def _moved(part: Grid, row: int, col: int, field: Field) -> Grid:
    """The same pixels, each at the place where the image shows them."""
    (x0, xc, xr), (y0, yc, yr) = field.coefficients
    right, down = col - GDAL_CENTRE - field.origin[1], row - GDAL_CENTRE - field.origin[0]
    move = Affine(1 + xc, xr, x0 + xc * right + xr * down, yc, 1 + yr, y0 + yc * right + yr * down)
    return Grid(part.crs_wkt, part.transform @ move, part.height, part.width, part.radius)


@dataclass(frozen=True)
class CameraSource:
    """An image as its camera took it, with as much of the scene's terrain as can hide a window from the camera.

    sun_position : (3,) body-fixed, m
    """

    image: CameraImage
    camera: Camera
    elevation: Any
    grid: Grid
    heights: tuple[float, float]
    sun_position: Floats

    def box(self) -> Box | None:
        return footprint(self.camera, self.grid, self.heights)

    def read(self, row: int, col: int, height: int, width: int, field: Field | None = None) -> Pixels:
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
        """Rows and columns from which terrain can hide the box: itself, and what lies towards the camera."""
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
        # the azimuth differs over the box, by little: one eighth to the sides
        side = math.ceil(reach / 8) + 2
        towards_row, towards_col = -north / level * reach, east / level * reach
        r0 = row + min(0, math.floor(towards_row)) - side
        r1 = row + height + max(0, math.ceil(towards_row)) + side
        c0 = col + min(0, math.floor(towards_col)) - side
        c1 = col + width + max(0, math.ceil(towards_col)) + side
        return max(0, r0), max(0, c0), min(rows, r1), min(cols, c1)
