"""Maps of coefficients as cloud-optimised GeoTIFF, for GDAL and QGIS: the HDF5 driver of GDAL drops georeferences."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import h5py
import numpy as np
import rasterio
import rasterio.io
import rasterio.shutil
from numba import njit
from numpy.typing import NDArray
from rasterio.transform import Affine
from rasterio.windows import Window

from schemas.reading import read_strings
from stages.physics.grid import Grid

Read = Callable[[Window], NDArray[np.float32]]  # -> (C, rows, columns)
TAGS = ("model", "quantity", "gsd_m", "body_radius_m")
ANYWHERE = Affine.scale(2, -2)  # the virtual file above the levels says where the map lies
BLOCK, STRIP, COLUMNS = 256, 512, 4096  # px; pieces hold whole blocks of their own level and of the next


def write_geotiff(path: Path, file: h5py.File, grid: Grid) -> None:
    """The maps as a cloud-optimised GeoTIFF: one band per coefficient, named; nodata NaN; model and quantity as tags.

    Overviews are means of what is known. GDAL would take longer to make them than the network's map takes to write.
    """
    names = read_strings(file, "coefficient_name")
    levels = [path.with_name(f"{path.name}.plain{k}.tif") for k in range(_overviews(grid.height, grid.width) + 1)]
    scheme = path.with_name(path.name + ".vrt")
    tags = {key: str(file.attrs[key]) for key in TAGS} | {"coefficients": json.dumps(names), "software": "lunargr"}
    try:
        coefficients = file["coefficients"]
        _write_levels(levels, grid.height, grid.width, len(names), lambda w: coefficients[(slice(None), *w.toslices())])
        scheme.write_text(_virtual(levels, grid, names, tags), encoding="utf-8")
        # Noise does not deflate: ZSTD's lowest level takes a third of the time of DEFLATE's and is as small.
        rasterio.shutil.copy(
            scheme, path, driver="COG", compress="ZSTD", level="1", predictor="3", blocksize=str(BLOCK), num_threads="ALL_CPUS",
        )  # fmt: skip
    finally:
        for temporary in (*levels, scheme):
            temporary.unlink(missing_ok=True)


def _overviews(height: int, width: int) -> int:
    """How often a map is halved until it fits into a block."""
    return max(0, math.ceil(math.log2(max(height, width) / BLOCK)))


def _pieces(height: int, width: int) -> Iterator[Window]:
    for row in range(0, height, STRIP):
        for column in range(0, width, COLUMNS):
            yield Window(column, row, min(COLUMNS, width - column), min(STRIP, height - row))


def _write_levels(levels: list[Path], height: int, width: int, count: int, read: Read) -> None:
    """Each level, not compressed. While one is written the next is made of it; GDAL's cache holds what is read again."""
    with contextlib.ExitStack() as files:
        shape, target = (height, width), _create(files, levels[0], height, width, count)
        for k in range(len(levels)):
            half = (-(-shape[0] // 2), -(-shape[1] // 2))
            smaller = _create(files, levels[k + 1], *half, count) if k + 1 < len(levels) else None
            for piece in _pieces(*shape):
                values = read(piece)
                if k == 0:
                    target.write(values, window=piece)
                if smaller is not None:
                    means = np.empty((count, -(-piece.height // 2), -(-piece.width // 2)), np.float32)
                    halve(np.ascontiguousarray(values), means)
                    place = Window(piece.col_off // 2, piece.row_off // 2, means.shape[2], means.shape[1])
                    smaller.write(means, window=place)
            if smaller is not None:
                smaller.close()
                shape, read = half, _reader(files.enter_context(rasterio.open(levels[k + 1])))


def _reader(source: rasterio.DatasetReader) -> Read:
    return lambda window: source.read(window=window)


def _create(files: contextlib.ExitStack, path: Path, height: int, width: int, count: int) -> rasterio.io.DatasetWriter:
    return files.enter_context(
        rasterio.open(
            path, "w", driver="GTiff", height=height, width=width, count=count, dtype="float32", nodata=math.nan, tiled=True,
            blockxsize=BLOCK, blockysize=BLOCK, BIGTIFF="IF_SAFER", transform=ANYWHERE,
        )
    )  # fmt: skip


def _virtual(levels: list[Path], grid: Grid, names: list[str], tags: dict[str, str]) -> str:
    """A GDAL virtual file: the first level with its place and names, the others as its overviews."""
    files = [f'<SourceFilename relativeToVRT="1">{escape(level.name)}</SourceFilename>' for level in levels]
    bands = []
    for k, name in enumerate(names, start=1):
        band = f"<SourceBand>{k}</SourceBand>"
        overviews = "".join(f"<Overview>{file}{band}</Overview>" for file in files[1:])
        bands.append(
            f'<VRTRasterBand dataType="Float32" band="{k}"><Description>{escape(name)}</Description>'
            f"<NoDataValue>nan</NoDataValue><SimpleSource>{files[0]}{band}</SimpleSource>{overviews}</VRTRasterBand>"
        )
    items = "".join(f"<MDI key={quoteattr(key)}>{escape(value)}</MDI>" for key, value in tags.items())
    transform = ", ".join(repr(float(v)) for v in grid.transform.to_gdal())
    return (
        f'<VRTDataset rasterXSize="{grid.width}" rasterYSize="{grid.height}"><SRS>{escape(grid.crs.to_wkt())}</SRS>'
        f"<GeoTransform>{transform}</GeoTransform><Metadata>{items}</Metadata>{''.join(bands)}</VRTDataset>"
    )


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
