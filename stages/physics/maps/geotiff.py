"""Maps of coefficients as cloud-optimised GeoTIFF, for GDAL and QGIS: the HDF5 driver of GDAL drops georeferences."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError  # what rasterio.shutil lets through
from rasterio.errors import RasterioIOError
from rasterio.io import DatasetReader, DatasetWriter
from rasterio.windows import Window

from schemas.files.outputs import atomic_path
from schemas.provenance import pack_record
from schemas.rasters import TIFF_TAG
from schemas.reading import read_strings
from stages.physics.maps.grid import Grid

TAGS = ("model", "quantity", "gsd_m", "body_radius_m")
ALBEDO_BANDS = ("albedo", "albedo_std")
REFINED_BANDS = ("elevation", "elevation_correction", "elevation_std")  # where photographs corrected the DEM
MOSAIC_BANDS = ("mosaic", "mosaic_std", "mosaic_scatter", "mosaic_images")
BLOCK, STRIP, COLUMNS = 256, 512, 4096  # px


class MapTiff:
    """A GeoTIFF that is written as its map is made, with named bands; nodata NaN. Use as a context manager.

    grid : where it lies, or an open raster on the same grid; units : of the bands, or none
    Pixels are written to a plain file beside ``path``, which GDAL's COG driver copies at the end, with overviews that are
    means of known pixels.
    """

    def __init__(
        self,
        path: Path,
        grid: Grid | DatasetReader,
        names: Sequence[str],
        tags: Mapping[str, Any],
        units: Sequence[str] = (),
    ) -> None:
        self.path, self.grid, self.names, self.units = path, grid, list(names), list(units)
        self.tags = {"software": "lunargr"} | {key: str(value) for key, value in tags.items()}
        self._plain = path.with_name(f"{path.name}.plain.tif")
        self._file: DatasetWriter | None = None

    def __enter__(self) -> MapTiff:
        # Noise does not deflate: ZSTD's lowest level takes a third of the time of DEFLATE's and is as small.
        self._file = rasterio.open(
            self._plain, "w", driver="GTiff", height=self.grid.height, width=self.grid.width, count=len(self.names),
            dtype="float32", nodata=math.nan, transform=self.grid.transform, crs=self.grid.crs, tiled=True, blockxsize=BLOCK,
            blockysize=BLOCK, interleave="pixel", compress="ZSTD", zstd_level=1, predictor=3, BIGTIFF="IF_SAFER",
        )  # fmt: skip
        self._file.update_tags(**self.tags)
        self._file.descriptions = self.names
        if self.units:
            self._file.units = self.units
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: Any) -> None:
        assert self._file is not None
        try:
            if kind is None:
                with _as_full_disk():
                    self._file.close()
                    rasterio.shutil.copy(
                        self._plain, self.path, driver="COG", COMPRESS="ZSTD", LEVEL=1, PREDICTOR="FLOATING_POINT",
                        BLOCKSIZE=BLOCK, OVERVIEW_RESAMPLING="AVERAGE", BIGTIFF="IF_SAFER",
                    )  # fmt: skip
            else:
                with contextlib.suppress(OSError, RasterioIOError):
                    # makes room on a full disk for the tiles that GDAL still holds: it would complain about each
                    os.truncate(self._plain, 0)
                    self._file.close()
        finally:
            self._plain.unlink(missing_ok=True)

    def put(self, row: int, col: int, values: NDArray[np.float32]) -> None:
        """Write a window. values : (C, h, w); row, col : of its first pixel"""
        assert self._file is not None
        with _as_full_disk():
            self._file.write(values, window=Window(col, row, values.shape[2], values.shape[1]))

    def put_all(self, *fields: h5py.Dataset) -> None:
        """Write the whole map. fields : (C, H, W) or (H, W) each, band after band"""
        for row in range(0, self.grid.height, STRIP):
            for col in range(0, self.grid.width, COLUMNS):
                part = np.s_[row : row + STRIP, col : col + COLUMNS]
                bands = [f[(slice(None), *part)] if f.ndim == 3 else f[part][None] for f in fields]
                self.put(row, col, np.concatenate(bands))


@contextlib.contextmanager
def _as_full_disk() -> Iterator[None]:
    """Raise OSError (no space left) where GDAL cannot write: it gives no reason, and a full disk is the usual one."""
    try:
        yield
    except (RasterioIOError, CPLE_BaseError) as error:
        raise OSError(errno.ENOSPC, str(error.__cause__ or error)) from None


def write_geotiff(path: Path, file: h5py.File, grid: Grid) -> None:
    """The map that an open artefact holds, as a cloud-optimised GeoTIFF: coefficients of an svbrdf.h5, or mosaics."""
    names, fields, tags = (_mosaics if "mosaic" in file else _coefficients)(file)
    units = ["m" if name in REFINED_BANDS else "1" for name in names]
    with atomic_path(path) as partial, MapTiff(partial, grid, names, tags, units) as tiff:
        tiff.put_all(*fields)


def _coefficients(file: h5py.File) -> tuple[list[str], list[h5py.Dataset], dict[str, str]]:
    """Bands, variables and tags of an svbrdf.h5; standard deviations, albedo and refined elevations are further bands."""
    fields = [file[name] for name in ("coefficients", "coefficients_std") if name in file]
    maps = read_strings(file, "map_name") if len(fields) > 1 else []
    further = [name for name in ALBEDO_BANDS if name in file]
    further += REFINED_BANDS if REFINED_BANDS[1] in file else ()
    names = [*band_names(read_strings(file, "coefficient_name"), maps), *further]
    return names, [*fields, *(file[name] for name in further)], map_tags(names, file.attrs)


def _mosaics(file: h5py.File) -> tuple[list[str], list[h5py.Dataset], dict[str, str]]:
    """Bands, variables and tags of a normalized.h5: its mosaics, layer by layer."""
    layers = [f"_{name}" if name else "" for name in read_strings(file, "layer_name")]
    names = [f"{name}{layer}" for name in MOSAIC_BANDS for layer in layers]
    return names, [file[name] for name in MOSAIC_BANDS], _root_tags(file.attrs)


def map_tags(names: Sequence[str], root: Mapping[str, Any]) -> dict[str, str]:
    """Tags of a map's GeoTIFF. names : of its bands; root : root attributes of its artefact"""
    return _root_tags(root) | {"coefficients": json.dumps([n for n in names if not n.endswith("_std")])}


def _root_tags(root: Mapping[str, Any]) -> dict[str, str]:
    return {key: str(root[key]) for key in TAGS} | {TIFF_TAG: pack_record(root)}


def band_names(coefficients: Sequence[str], maps: Sequence[str]) -> list[str]:
    """The coefficients, and after them the standard deviations of those that vary by place."""
    return [*coefficients, *(f"{name}_std" for name in maps)]
