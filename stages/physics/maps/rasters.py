"""Opening the user's rasters (anything GDAL reads) and bringing windows of them onto a grid, nodata and all."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.warp
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import NotGeoreferencedWarning, RasterioError, RasterioIOError
from rasterio.io import DatasetReader
from rasterio.transform import Affine
from rasterio.warp import Resampling
from rasterio.windows import Window

from schemas.errors import InputError
from stages.common.memory import return_freed_memory
from stages.physics.maps.grid import Grid, ellipsoid_of, latitude_squash

# ISIS special pixels of 32-bit cubes (NULL, LRS, LIS, HIS, HRS) all lie beyond this; so do -3.4028e38 in its spellings.
SPECIAL = 3.4e38
# 16-bit and 8-bit cubes keep their specials at the ends of the range.
_SPECIAL_INT16 = (-32768, -32767, -32766, -32765, -32764)
_SPECIAL_UINT16 = (0, 1, 2, 65534, 65535)
_SPECIAL_UINT8 = (0, 255)

LARGEST_WINDOW = 1 << 22  # source pixels that are warped at a time: 0.2 GB with all that is made of them

Mask = NDArray[np.bool_]


@contextlib.contextmanager
def open_raster(path: Path, what: str = "a raster") -> Iterator[DatasetReader]:
    """Open a raster for reading. Raises InputError for a missing, damaged or unknown file, also while reading."""
    if not Path(path).exists():
        raise InputError(f"{path}: no such file; expected {what}. Check the path.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = rasterio.open(path)
    except RasterioIOError as error:
        raise InputError(
            f"{path}: expected {what} that GDAL reads, found something else ({_one_line(error)})."
        ) from None
    try:
        with dataset:
            yield dataset
    except RasterioError as error:
        raise InputError(
            f"{path}: cannot be read to the end ({_one_line(error)}); the file is damaged or truncated, fetch it again."
        ) from None
    finally:
        return_freed_memory()  # the pieces that a raster's blocks leave would grow by 0.1 GB with every image


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


def source_window(dataset: DatasetReader, grid: Grid, margin: int = 2) -> Window | None:
    """The window of a raster that covers a grid, None where they do not meet."""
    rows = np.concatenate([np.linspace(-0.5, grid.height - 0.5, 9)] * 4 + [np.full(9, grid.height / 2)])
    cols = np.concatenate(
        [np.full(9, v) for v in np.linspace(-0.5, grid.width - 0.5, 4)] + [np.linspace(-0.5, grid.width - 0.5, 9)]
    )
    x, y = grid.xy(rows, cols)
    x, y = transform_points(grid, dataset, x, y)
    inverse = ~dataset.transform
    u = inverse.a * x + inverse.b * y + inverse.c
    v = inverse.d * x + inverse.e * y + inverse.f
    good = np.isfinite(u) & np.isfinite(v)
    if not good.any():
        return None
    c0 = max(0, int(np.floor(u[good].min())) - margin)
    c1 = min(dataset.width, int(np.ceil(u[good].max())) + margin)
    r0 = max(0, int(np.floor(v[good].min())) - margin)
    r1 = min(dataset.height, int(np.ceil(v[good].max())) + margin)
    return Window(c0, r0, c1 - c0, r1 - r0) if c1 > c0 and r1 > r0 else None


def transform_points(grid: Grid, dataset: DatasetReader, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Map coordinates of a grid -> those of a raster on the same body.

    A geographic raster may count longitudes 0..360 or -180..180: the points follow the raster's own domain.
    """
    if grid.squash == latitude_squash(dataset.crs):
        tx, ty = rasterio.warp.transform(grid.crs, dataset.crs, x, y)
        tx, ty = np.asarray(tx), np.asarray(ty)
    else:
        own = Grid(dataset.crs.to_wkt(), Affine.identity(), dataset.height, dataset.width, grid.radius)
        tx, ty = own.map_xy(*grid.map_lonlat(x, y))
    if dataset.crs.is_geographic:
        left = min(dataset.bounds.left, dataset.bounds.right)
        tx = (tx - left) % 360.0 + left
        # what lies just west of the raster must not wrap to its far east
        tx = np.where(tx - left > 360.0 - 0.05 * 360.0, tx - 360.0, tx)
    return tx, ty


def warp(dataset: DatasetReader, grid: Grid, resampling: Resampling, band: int = 1) -> tuple[NDArray[np.float32], Mask]:
    """A raster on a grid: values (NaN where unknown) and where every contribution was valid.

    Area-weighted for ``Resampling.average``. Only the window that the grid needs is read, piece by piece where it is large.
    """
    values = np.full((grid.height, grid.width), np.nan, np.float32)
    window = source_window(dataset, grid)
    if window is None:
        return values, np.zeros(values.shape, bool)
    if window.width * window.height > LARGEST_WINDOW and values.size > 1:
        return _warp_halves(dataset, grid, resampling, band)
    source = read_window(dataset, window, band)
    transform = dataset.window_transform(window)
    invalid = ~np.isfinite(source)
    if invalid.all():
        return values, np.zeros(values.shape, bool)
    base = float(source[~invalid].mean())  # float32 in GDAL's kernels: keep the numbers small
    common = {
        "src_transform": transform,
        "src_crs": dataset.crs,
        "dst_transform": grid.transform,
        "dst_crs": grid.crs,
        "tolerance": 0,
    } | _latitudes(dataset, grid)
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


def _latitudes(dataset: DatasetReader, grid: Grid) -> dict[str, Any]:
    """What GDAL must be told where raster and grid count latitudes in different ways: see latitude_squash."""
    if latitude_squash(dataset.crs) == grid.squash:
        return {}
    steps = []
    for crs, inverse in ((dataset.crs, True), (grid.crs, False)):
        figure = ellipsoid_of(crs)
        geocentric = f"+step {'' if inverse else '+inv '}+proj=geoc {figure}"
        if crs.is_geographic:
            units = ("deg", "rad") if inverse else ("rad", "deg")
            projection = f"+step +proj=unitconvert +xy_in={units[0]} +xy_out={units[1]}"
        else:
            projection = f"+step {'+inv ' if inverse else ''}{_plain(crs.to_proj4())}"
        pair = [projection, geocentric] if latitude_squash(crs) != 1.0 else [projection]
        steps += pair if inverse else pair[::-1]
    # CRSs from PROJ strings count east first, as the pipeline does; those from files may not
    return {
        "src_crs": CRS.from_proj4(dataset.crs.to_proj4()),
        "dst_crs": CRS.from_proj4(grid.crs.to_proj4()),
        "COORDINATE_OPERATION": " ".join(["+proj=pipeline", *steps]),
    }


def _plain(proj4: str) -> str:
    return " ".join(word for word in proj4.split() if not word.startswith(("+no_defs", "+type", "+wktext")))


def choose_resampling(dataset: DatasetReader, grid: Grid) -> tuple[Resampling, float]:
    """Area mean when coarsening, cubic otherwise; and the raster's own pixel size at the grid's centre, m."""
    size = pixel_size(dataset, grid.radius, *(np.ravel(v)[0] for v in grid.lonlat(grid.height / 2, grid.width / 2)))
    return (Resampling.average if grid.gsd > 1.05 * max(size) else Resampling.bilinear), max(size)


def pixel_size(dataset: DatasetReader, radius: float, longitude_deg: float, latitude_deg: float) -> tuple[float, float]:
    """True size in metres of a raster's pixel (along columns, along rows) at a place on the body."""
    own = Grid(dataset.crs.to_wkt(), dataset.transform, dataset.height, dataset.width, radius)
    x, y = own.map_xy(np.array([longitude_deg]), np.array([latitude_deg]))
    u, v = ~dataset.transform @ (x[0], y[0])
    return pixel_size_at(dataset, radius, v, u)


def pixel_size_at(dataset: DatasetReader, radius: float, row: float, col: float) -> tuple[float, float]:
    """True size in metres of the pixel at a GDAL (corner) row and column: (along columns, along rows)."""
    grid = Grid(dataset.crs.to_wkt(), dataset.transform, dataset.height, dataset.width, radius)
    north, east = grid.local_frames(row - 0.5, col - 0.5).pixel_size[0]
    return float(east), float(north)
