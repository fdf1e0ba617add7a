"""Maps of coefficients as cloud-optimised GeoTIFF, for GDAL and QGIS: the HDF5 driver of GDAL drops georeferences."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
import rasterio
import rasterio.io
from numba import njit
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import RasterioIOError
from rasterio.transform import Affine
from rasterio.windows import Window

from schemas.provenance import pack_record
from schemas.rasters import TIFF_TAG
from schemas.reading import read_strings
from stages.physics.maps import cog
from stages.physics.maps.grid import Grid

TAGS = ("model", "quantity", "gsd_m", "body_radius_m")
ALBEDO_BANDS = ("albedo", "albedo_std")
ANYWHERE = Affine.scale(2, -2)  # the map says where its overviews lie
BLOCK, STRIP, COLUMNS = 256, 512, 4096  # px; pieces hold whole blocks of their own level and of the next
DIRECT = 3  # overviews made of what is at hand; the smaller ones, a 64th of the map, are made of the last of these
EVEN = 1 << DIRECT  # px


class Placed(Protocol):
    """Where a raster lies: a grid, or another raster that is open."""

    @property
    def crs(self) -> CRS | None:
        """None where unknown."""

    @property
    def transform(self) -> Affine:
        """GDAL's, pixel corners to map coordinates."""

    @property
    def height(self) -> int:
        """px"""

    @property
    def width(self) -> int:
        """px"""


class MapTiff:
    """A GeoTIFF that is written as its map is made, with named bands; nodata NaN. Use as a context manager.

    units : of the bands, or none. Overviews are means of what is known. Every level grows in a file of its own beside ``path``.
    """

    def __init__(
        self, path: Path, grid: Placed, names: Sequence[str], tags: Mapping[str, Any], units: Sequence[str] = ()
    ) -> None:
        self.path, self.grid, self.names, self.units = path, grid, list(names), list(units)
        self.tags = {"software": "lunargr"} | {key: str(value) for key, value in tags.items()}
        # Halved until it fits into a block.
        overviews = max(0, math.ceil(math.log2(max(grid.height, grid.width) / BLOCK)))
        self.shapes = [(-(-grid.height >> k), -(-grid.width >> k)) for k in range(overviews + 1)]
        self.levels = [path.with_name(f"{path.name}.level{k}.tif") for k in range(overviews + 1)]
        self._stack = contextlib.ExitStack()
        self._open: list[rasterio.io.DatasetWriter] = []

    def __enter__(self) -> MapTiff:
        with contextlib.ExitStack() as stack:
            for level in self.levels:
                stack.callback(level.unlink, missing_ok=True)
            self._open = [stack.enter_context(self._create(k)) for k in range(min(DIRECT + 1, len(self.levels)))]
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: Any) -> None:
        with self._stack:
            if kind is None:
                with _told():
                    for file in self._open:
                        file.close()
                    for k in range(len(self._open) - 1, len(self.levels) - 1):
                        self._halve(k)
                cog.join(self.levels, self.path)
            else:
                # Room for what GDAL still holds: it would say of each tile that there is none.
                for level in self.levels[: len(self._open)]:
                    with contextlib.suppress(OSError):
                        os.truncate(level, 0)

    def put(self, row: int, col: int, values: NDArray[np.float32]) -> None:
        """values : (C, n, w) of the map, from a row and column on, and up to such or the map's end, that are multiples of EVEN."""
        for k, level in enumerate(self._open):
            if k:
                row, col, values = row // 2, col // 2, halved(values)
            with _told():
                level.write(values, window=Window(col, row, values.shape[2], values.shape[1]))

    def put_all(self, *fields: h5py.Dataset) -> None:
        """fields : (C, H, W) or (H, W) each, band after band"""
        for piece in _pieces(*self.shapes[0]):
            part = piece.toslices()
            bands = [f[(slice(None), *part)] if f.ndim == 3 else f[part][None] for f in fields]
            self.put(piece.row_off, piece.col_off, np.concatenate(bands))

    def _create(self, level: int) -> rasterio.io.DatasetWriter:
        height, width = self.shapes[level]
        place = {"transform": ANYWHERE} if level else {"transform": self.grid.transform, "crs": self.grid.crs}
        # Noise does not deflate: ZSTD's lowest level takes a third of the time of DEFLATE's and is as small.
        file = rasterio.open(
            self.levels[level], "w", driver="GTiff", height=height, width=width, count=len(self.names), dtype="float32",
            nodata=math.nan, tiled=True, blockxsize=BLOCK, blockysize=BLOCK, interleave="pixel", compress="ZSTD", zstd_level=1,
            predictor=3, BIGTIFF="YES", ENDIANNESS="LITTLE", **place,
        )  # fmt: skip
        if level == 0:
            file.update_tags(**self.tags)
            file.descriptions = self.names
            if self.units:
                file.units = self.units
        return file

    def _halve(self, level: int) -> None:
        with rasterio.open(self.levels[level]) as source, self._create(level + 1) as target:
            for piece in _pieces(*self.shapes[level]):
                means = halved(source.read(window=piece))
                place = Window(piece.col_off // 2, piece.row_off // 2, means.shape[2], means.shape[1])
                target.write(means, window=place)


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """GDAL says that it could not write, and not why: the disk is full, or what comes to the same."""
    try:
        yield
    except RasterioIOError as error:
        raise OSError(errno.ENOSPC, str(error.__cause__ or error)) from None


def write_geotiff(path: Path, file: h5py.File, grid: Grid) -> None:
    """The map that an open artefact holds, as a cloud-optimised GeoTIFF; with standard deviations and albedo as further bands."""
    fields = [file[name] for name in ("coefficients", "coefficients_std") if name in file]
    maps = read_strings(file, "map_name") if len(fields) > 1 else []
    further = [name for name in ALBEDO_BANDS if name in file]
    names = [*band_names(read_strings(file, "coefficient_name"), maps), *further]
    with MapTiff(path, grid, names, map_tags(names, file.attrs), ["1"] * len(names)) as tiff:
        tiff.put_all(*fields, *(file[name] for name in further))


def map_tags(names: Sequence[str], root: Mapping[str, Any]) -> dict[str, str]:
    """What the GeoTIFF of a map says of it. root : of its artefact"""
    return {
        **{key: str(root[key]) for key in TAGS},
        "coefficients": json.dumps([n for n in names if not n.endswith("_std")]),
        TIFF_TAG: pack_record(root),
    }


def band_names(coefficients: Sequence[str], maps: Sequence[str]) -> list[str]:
    """The coefficients, and after them the standard deviations of those that vary by place."""
    return [*coefficients, *(f"{name}_std" for name in maps)]


def _pieces(height: int, width: int) -> Iterator[Window]:
    for row in range(0, height, STRIP):
        for column in range(0, width, COLUMNS):
            yield Window(column, row, min(COLUMNS, width - column), min(STRIP, height - row))


def halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of what is not NaN in squares of 2 x 2: (C, H, W) -> (C, ceil(H / 2), ceil(W / 2))."""
    count, height, width = values.shape
    out = np.empty((count, -(-height // 2), -(-width // 2)), np.float32)
    halve(np.ascontiguousarray(values), out)
    return out


@njit(nogil=True, cache=True)
def halve(values, out):
    """Means of what is not NaN in squares of 2 x 2. values : (C, H, W) float32; out : (C, ceil(H / 2), ceil(W / 2))"""
    height, width = values.shape[1:]
    for n in range(values.shape[0]):
        for r in range(out.shape[1]):
            upper = values[n, 2 * r]
            lower = values[n, min(2 * r + 1, height - 1)]
            to = out[n, r]
            for k in range(width // 2):
                a, b, c, d = upper[2 * k], upper[2 * k + 1], lower[2 * k], lower[2 * k + 1]
                total = a + b + c + d
                if total == total:
                    to[k] = total * np.float32(0.25)
                else:
                    to[k] = _mean(a, b, c, d)
            if width % 2:
                a, c = upper[width - 1], lower[width - 1]
                to[width // 2] = _mean(a, a, c, c)


@njit(nogil=True, cache=True)
def _mean(a, b, c, d):
    total, known = np.float32(0), np.float32(0)
    for v in (a, b, c, d):
        if v == v:
            total += v
            known += np.float32(1)
    return total / known if known > 0 else np.float32(np.nan)
