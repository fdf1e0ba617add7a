"""Maps of coefficients as cloud-optimised GeoTIFF, for GDAL and QGIS: the HDF5 driver of GDAL drops georeferences."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import h5py
import rasterio
import rasterio.shutil
from rasterio.windows import Window

from schemas.reading import read_strings
from stages.physics.grid import Grid

TAGS = ("model", "quantity", "gsd_m", "body_radius_m")


def _strips(height: int, rows: int = 512) -> Iterator[tuple[int, int]]:
    for first in range(0, height, rows):
        yield first, min(height, first + rows)


def write_geotiff(path: Path, file: h5py.File, grid: Grid) -> None:
    """The maps as a cloud-optimised GeoTIFF: one band per coefficient, named; nodata NaN; model and quantity as tags."""
    names = read_strings(file, "coefficient_name")
    plain = path.with_name(path.name + ".plain.tif")
    profile = {
        "driver": "GTiff", "height": grid.height, "width": grid.width, "count": len(names), "dtype": "float32", "crs": grid.crs,
        "transform": grid.transform, "nodata": math.nan, "tiled": True, "blockxsize": 256, "blockysize": 256, "BIGTIFF": "IF_SAFER",
    }  # fmt: skip
    try:
        with rasterio.open(plain, "w", **profile) as out:
            for first, last in _strips(grid.height):
                window = Window(0, first, grid.width, last - first)
                out.write(file["coefficients"][:, first:last], window=window)
            for k, name in enumerate(names, start=1):
                out.set_band_description(k, name)
            tags = {key: file.attrs[key] for key in TAGS} | {
                "coefficients": json.dumps(names),
                "software": "lunargr",
            }
            out.update_tags(**{key: str(value) for key, value in tags.items()})
        # Noise does not deflate: the highest level would take three times as long and save 3 %.
        rasterio.shutil.copy(
            plain, path, driver="COG", compress="DEFLATE", level="1", predictor="3", blocksize="256",
            overview_resampling="average", num_threads="ALL_CPUS",
        )  # fmt: skip
    finally:
        plain.unlink(missing_ok=True)
