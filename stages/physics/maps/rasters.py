"""Opening the user's rasters (anything that GDAL reads) and resampling windows of them onto a grid."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import rasterio
import rasterio.warp
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError, RasterioIOError
from rasterio.io import DatasetReader
from rasterio.warp import Resampling
from rasterio.windows import Window

from schemas.errors import InputError
from schemas.files.hdf5 import open_hdf5, silence_hdf5
from schemas.files.references import open_raster_file
from schemas.files.user_files import check_file
from schemas.units import unit_name
from stages.common.arrays import Mask
from stages.common.memory import return_freed_memory
from stages.physics.maps.grid import GDAL_CENTRE, Grid
from stages.physics.maps.projections import TURN, near_longitude, operation

# ISIS special pixels of 32-bit cubes (NULL, LRS, LIS, HIS, HRS) all lie beyond this; so do -3.4028e38 in its spellings.
SPECIAL = 3.4e38
# 16-bit and 8-bit cubes keep their specials at the ends of the range.
_SPECIAL_INT16 = (-32768, -32767, -32766, -32765, -32764)
_SPECIAL_UINT16 = (0, 1, 2, 65534, 65535)
_SPECIAL_UINT8 = (0, 255)

LARGEST_WINDOW = 1 << 22  # source pixels that are warped at a time: 0.2 GB with all that is made of them


@contextlib.contextmanager
def open_raster(path: Path, what: str = "a raster", band: str = "") -> Iterator[DatasetReader]:
    """Open a raster for reading, as of one band where one of several has the name ``band``.

    Raises InputError for a missing, damaged or unknown file, also while reading.
    """
    check_file(Path(path), what)
    silence_hdf5()
    if h5py.is_hdf5(path):  # of a damaged one GDAL's HDF5 library would print its whole error stack
        open_hdf5(Path(path)).close()
    try:
        dataset = open_raster_file(Path(path))
        # GDAL takes what follows a question mark for options
        if dataset.count > 1 and dataset.descriptions.count(band) == 1 and "?" not in str(path):
            dataset.close()
            dataset = rasterio.open(f"vrt://{path}?bands={dataset.descriptions.index(band) + 1}")
    except RasterioIOError as error:
        raise InputError(
            f"{path}: expected {what} that GDAL reads, found something else ({_one_line(error)}); is it the right file?"
        ) from None
    try:
        with dataset:
            _check_numbers(path, what, dataset)
            yield dataset
    except RasterioError as error:
        raise InputError(
            f"{path}: cannot be read to the end ({_one_line(error)}); the file is damaged or truncated, fetch it again."
        ) from None
    finally:
        return_freed_memory()  # GDAL's blocks leave fragments, which would grow by 0.1 GB with every image


def _check_numbers(path: Path, what: str, dataset: DatasetReader) -> None:
    if not dataset.count:
        raise InputError(
            f"{path}: expected {what}, found a file without bands; name one of its subdatasets (gdalinfo)."
        )
    if "complex" in dataset.dtypes[0] or dataset.dtypes[0] == "cint16":
        raise InputError(
            f"{path}: expected {what} of real numbers, found {dataset.dtypes[0]}; take one part "
            "(gdal_calc.py, 'numpy.real(A)')."
        )
    scale, offset = dataset.scales[0], dataset.offsets[0]
    if not (math.isfinite(scale) and math.isfinite(offset) and scale != 0):
        raise InputError(
            f"{path}: expected a finite scale and offset, found {scale} and {offset}; set them with gdal_edit.py."
        )


def check_single_band(
    path: Path, dataset: DatasetReader, what: str, advice: str = "take the one that is meant (gdal_translate -b N)"
) -> None:
    """Refuse rasters of several bands, alpha bands aside. Raises InputError."""
    bands = sum(kind != ColorInterp.alpha for kind in dataset.colorinterp)
    if bands > 1:
        raise InputError(f"{path}: expected {what} of one band, found {bands}; {advice}.")


def choose_band(path: Path, dataset: DatasetReader, band: int | None, what: str) -> int:
    """The band to read of an image: the one asked for, counted from 1, or the only one. Raises InputError."""
    if band is None:
        check_single_band(path, dataset, what, "name the one that is meant in column 'band' of the image table")
        return 1
    if band > dataset.count:
        raise InputError(f"{path}: expected {what} with a band {band}, found {dataset.count}; mend the column 'band'.")
    return band


# m; for advice
_LENGTHS = dict.fromkeys(("km", "kilometre", "kilometer", "kilometers", "kilometres"), 1000.0)
_LENGTHS |= dict.fromkeys(("ft", "foot", "feet"), 0.3048) | dict.fromkeys(("us survey foot", "us-ft"), 12 / 39.37)
_VERTICAL = re.compile(
    r'(?:VERT_?CRS|VERT_CS|VERTICALCRS)\[.*?(?:LENGTHUNIT|UNIT)\["([^"]*)",\s*([0-9.eE+-]+)', re.DOTALL
)


def check_metres(path: Path, dataset: DatasetReader) -> None:
    """Refuse elevations whose file names another unit than the metre. Raises InputError."""
    unit = (dataset.units[0] or "").strip().lower()
    factor = 1.0
    if not unit and dataset.crs is not None and (vertical := _VERTICAL.search(dataset.crs.to_wkt())):
        unit, factor = vertical.group(1).lower(), float(vertical.group(2))
    if unit_name(unit) in ("", "m") or (factor != 1.0 and abs(factor - 1) < 1e-9):
        return
    metres = factor if factor != 1.0 else _LENGTHS.get(unit)
    advice = f"convert them (gdal_calc.py, 'A*{metres:g}')" if metres else "convert them, or set the unit that is true"
    raise InputError(
        f"{path}: expected elevations in metres, found the unit '{unit}'; {advice} and say so (gdal_edit.py -units m)."
    )


def _one_line(error: BaseException) -> str:
    cause = error.__cause__ or error
    return " ".join(str(cause).split())[:160]


def read_window(dataset: DatasetReader, window: Window, band: int = 1) -> NDArray[np.float64]:
    """A window as float64 in physical units, NaN wherever it is nodata in any spelling.

    Honours masks, nodata tags, scale and offset; NaN, infinities, -3.4028227e38 and ISIS special pixels are nodata.
    """
    raw = dataset.read(band, window=window, masked=True)
    invalid = np.ma.getmaskarray(raw)
    values = np.ma.getdata(raw)
    if values.dtype.kind == "f":
        invalid = invalid | ~np.isfinite(values) | (np.abs(values) >= SPECIAL)
    elif dataset.driver in ("ISIS3", "PDS", "PDS4", "VICAR") and values.dtype == np.int16:
        invalid = invalid | np.isin(values, _SPECIAL_INT16)
    elif dataset.driver == "ISIS3" and values.dtype in (np.uint8, np.uint16):
        invalid = invalid | np.isin(values, _SPECIAL_UINT8 if values.dtype == np.uint8 else _SPECIAL_UINT16)
    elif values.dtype == np.int16 and dataset.nodata is None:
        invalid = invalid | (values == -32768)
    scale, offset = dataset.scales[band - 1], dataset.offsets[band - 1]
    # In float64 first: radii of 1,737,400 m leave no room for decimetres in float32.
    result = values.astype(np.float64) * scale + offset if (scale, offset) != (1.0, 0.0) else values.astype(np.float64)
    result[invalid] = np.nan
    return result


def placements(dataset: DatasetReader, grid: Grid, margin: int = 2) -> list[tuple[float, Window]]:
    """The longitudes about which a raster's map is continued where it covers some of a grid, and its window for each.

    More than one where the raster's own ends lie on the grid, as those of a map of the whole body.
    """
    rows = np.concatenate([np.linspace(-0.5, grid.height - 0.5, 9)] * 4 + [np.full(9, grid.height / 2)])
    cols = np.concatenate(
        [np.full(9, v) for v in np.linspace(-0.5, grid.width - 0.5, 4)] + [np.linspace(-0.5, grid.width - 0.5, 9)]
    )
    own = grid_of(dataset, grid.radius)
    lon, lat = grid.lonlat(rows, cols)
    nearest = float(near_longitude(grid.middle_longitude_deg, own.middle_longitude_deg))
    found = []
    for middle in (nearest, nearest - TURN, nearest + TURN) if own.continued else (nearest,):
        u, v = ~dataset.transform @ own.map_xy(lon, lat, middle)
        window = _covering(dataset, u, v, margin)
        if window is not None:
            found.append((middle, window))
    return found


def _covering(dataset: DatasetReader, u: NDArray, v: NDArray, margin: int) -> Window | None:
    """The window of a raster around points at columns u and rows v, px from its corner; None where it has none."""
    good = np.isfinite(u) & np.isfinite(v)
    if not good.any():
        return None
    c0 = max(0, int(np.floor(u[good].min())) - margin)
    c1 = min(dataset.width, int(np.ceil(u[good].max())) + margin)
    r0 = max(0, int(np.floor(v[good].min())) - margin)
    r1 = min(dataset.height, int(np.ceil(v[good].max())) + margin)
    return Window(c0, r0, c1 - c0, r1 - r0) if c1 > c0 and r1 > r0 else None


def grid_of(dataset: DatasetReader, radius: float) -> Grid:
    """The grid of a raster on a body of that radius, m."""
    return Grid(dataset.crs.to_wkt(), dataset.transform, dataset.height, dataset.width, radius)


def warp(dataset: DatasetReader, grid: Grid, resampling: Resampling, band: int = 1) -> tuple[NDArray[np.float32], Mask]:
    """A raster on a grid: values (NaN where unknown) and where every contribution was valid.

    Area-weighted for ``Resampling.average``. Only the window that the grid needs is read, piece by piece where it is large.
    """
    values, valid = np.full((grid.height, grid.width), np.nan, np.float32), np.zeros((grid.height, grid.width), bool)
    placed = placements(dataset, grid)
    if any(window.width * window.height > LARGEST_WINDOW for _, window in placed) and values.size > 1:
        return _warp_halves(dataset, grid, resampling, band)
    for middle, window in placed:
        more, more_valid = _warp_window(dataset, grid, resampling, band, middle, window)
        better = (more_valid & ~valid) | np.isnan(values)
        values[better], valid[better] = more[better], more_valid[better]
    return values, valid


def _warp_window(
    dataset: DatasetReader, grid: Grid, resampling: Resampling, band: int, middle: float, window: Window
) -> tuple[NDArray[np.float32], Mask]:
    """A window of a raster, as :func:`placements` gives it, on a grid."""
    values = np.full((grid.height, grid.width), np.nan, np.float32)
    source = read_window(dataset, window, band)
    invalid = ~np.isfinite(source)
    if invalid.all():
        return values, np.zeros(values.shape, bool)
    base = float(source[~invalid].mean())  # float32 in GDAL's kernels: keep the numbers small
    common = {
        "src_transform": dataset.window_transform(window),
        "dst_transform": grid.transform,
        "tolerance": 0,
    } | operation(dataset.crs.to_wkt(), grid.crs_wkt, middle)
    rasterio.warp.reproject(
        (source - base).astype(np.float32),
        values,
        src_nodata=np.nan,
        dst_nodata=np.nan,
        resampling=resampling,
        **common,
    )
    values += np.float32(base)
    valid = np.isfinite(values)
    if invalid.any():
        bad = np.zeros(values.shape, np.float32)
        coverage = Resampling.average if resampling == Resampling.average else Resampling.bilinear
        rasterio.warp.reproject(invalid.astype(np.float32), bad, resampling=coverage, **common)
        valid &= bad < 1e-3
    return values, valid


def _warp_halves(
    dataset: DatasetReader, grid: Grid, resampling: Resampling, band: int
) -> tuple[NDArray[np.float32], Mask]:
    axis = 0 if grid.height >= grid.width else 1
    middle = (grid.height, grid.width)[axis] // 2
    if axis == 0:
        halves = grid.window(0, 0, middle, grid.width), grid.window(middle, 0, grid.height - middle, grid.width)
    else:
        halves = grid.window(0, 0, grid.height, middle), grid.window(0, middle, grid.height, grid.width - middle)
    first, second = (warp(dataset, half, resampling, band) for half in halves)
    return np.concatenate([first[0], second[0]], axis), np.concatenate([first[1], second[1]], axis)


def choose_resampling(dataset: DatasetReader, grid: Grid) -> tuple[Resampling, float]:
    """Area mean when coarsening, bilinear otherwise; and the raster's own pixel size at the grid's centre, m."""
    size = pixel_size(dataset, grid.radius, *(np.ravel(v)[0] for v in grid.lonlat(grid.height / 2, grid.width / 2)))
    return (Resampling.average if grid.gsd > 1.05 * max(size) else Resampling.bilinear), max(size)


def pixel_size(dataset: DatasetReader, radius: float, longitude_deg: float, latitude_deg: float) -> tuple[float, float]:
    """True size in metres of a raster's pixel (along columns, along rows) at a place on the body."""
    x, y = grid_of(dataset, radius).map_xy(np.array([longitude_deg]), np.array([latitude_deg]))
    u, v = ~dataset.transform @ (x[0], y[0])
    return pixel_size_at(dataset, radius, v, u)


def pixel_size_at(dataset: DatasetReader, radius: float, row: float, col: float) -> tuple[float, float]:
    """True size in metres of the pixel at a GDAL (corner) row and column: (along columns, along rows)."""
    north, east = grid_of(dataset, radius).local_frames(row - GDAL_CENTRE, col - GDAL_CENTRE).pixel_size[0]
    return float(east), float(north)
