"""The choice of the working grid, and of how the DEM is resampled onto it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.transform import Affine
from rasterio.warp import Resampling, calculate_default_transform
from rasterio.windows import Window

from schemas import ConfigError, GeometryError, InputError
from stages.common.progress import Progress, show_nothing
from stages.physics.maps import rasters
from stages.physics.maps.grid import Grid, local_metric_crs
from stages.physics.maps.projections import operation

# A map whose pixels are within this of square and of the working GSD counts as metric: no resampling, only means.
METRIC_TOLERANCE = 0.01
LARGEST_REACH = math.radians(30)  # from the centre: a local stereographic map's scale is 7 % too large there
ANY_RELIEF = 0.006  # of the radius: Olympus Mons; Vesta's and Phobos' shapes go beyond, their DEMs' datum does not


@dataclass(frozen=True)
class Plan:
    """How the DEM is brought onto its grid.

    factor : DEM pixels along a grid pixel, of which means are taken; None for a reprojection
    holds_radii : whether the DEM holds distances from the body's centre instead of heights
    """

    grid: Grid
    factor: int | None
    resampling: Resampling
    holds_radii: bool


def plan_grid(
    dem: Path, dataset: DatasetReader, gsd: float | None, radius: float, progress: Progress = show_nothing
) -> Plan:
    """Area means where the DEM's grid is metric and divides the GSD, otherwise a local metric grid."""
    rasters.check_single_band(dem, dataset, "a DEM")
    rasters.check_metres(dem, dataset)
    east, north = rasters.pixel_size_at(dataset, radius, dataset.height / 2, dataset.width / 2)
    native = max(east, north)
    if gsd is not None and not (math.isfinite(gsd) and gsd > 0):
        raise ConfigError(f"`gsd`: expected a positive number of metres, found {gsd}.")
    if not (math.isfinite(native) and native > 0):
        raise GeometryError(f"{dem}: its georeference puts the DEM off the body; check its CRS and transform.")
    wanted = native if gsd is None else gsd
    if wanted < 0.5 * native:
        raise ConfigError(
            f"`gsd`: expected at least half the DEM's own {native:g} m, found {wanted:g}; detail cannot be invented."
        )
    holds_radii = _holds_radii(dem, dataset, radius, progress)
    t = dataset.transform
    north_up = t.b == t.d == 0 and t.a > 0 > t.e
    if dataset.crs.is_projected and north_up and abs(dataset.crs.linear_units_factor[1] - 1) < 1e-6:  # metres
        step = abs(t.a)
        factor = max(1, round(wanted / step))
        # At the centre and near the corners: an equirectangular map is true on one parallel only.
        places = [(v, u) for v in (0.1, 0.5, 0.9) for u in (0.1, 0.5, 0.9)]
        true = np.array(
            [rasters.pixel_size_at(dataset, radius, v * dataset.height, u * dataset.width) for v, u in places]
        )
        true_square = (
            bool((np.abs(true[:, 0] - true[:, 1]) <= METRIC_TOLERANCE * native).all())
            and abs(-t.e - t.a) <= 1e-3 * step
        )
        true_scale = bool((np.abs(true - step) <= 2 * METRIC_TOLERANCE * step).all())
        fits = gsd is None or abs(wanted - factor * step) <= 1e-3 * wanted
        if true_square and true_scale and fits:
            height, width = dataset.height // factor, dataset.width // factor
            if min(height, width) < 1:
                raise ConfigError(f"`gsd`: {wanted:g} m is coarser than the whole DEM; choose a finer one.")
            transform = t @ Affine.scale(factor)
            return Plan(
                Grid(dataset.crs.to_wkt(), transform, height, width, radius), factor, Resampling.average, holds_radii
            )
    whole = Grid(dataset.crs.to_wkt(), t, dataset.height, dataset.width, radius)
    lon, lat = (float(v) for v in whole.lonlat(dataset.height / 2 - 0.5, dataset.width / 2 - 0.5))
    reach = np.hypot(dataset.height * north, dataset.width * east) / 2 / radius
    if not (abs(lat) <= 90 and math.isfinite(lon)):
        raise GeometryError(f"{dem}: its georeference puts the DEM off the body; check its CRS and transform.")
    if not reach < LARGEST_REACH:
        raise GeometryError(
            f"{dem}: expected a region that one local map can hold (up to {math.degrees(2 * LARGEST_REACH):.0f} deg across), "
            f"found {math.degrees(2 * reach):.0f} deg; cut a region out first (gdal_translate -projwin)."
        )
    crs = local_metric_crs(lon, lat, radius)
    transform, width, height = calculate_default_transform(
        **operation(whole.crs_wkt, crs.to_wkt(), whole.middle_longitude_deg),
        width=dataset.width, height=dataset.height, left=dataset.bounds.left, bottom=dataset.bounds.bottom,
        right=dataset.bounds.right, top=dataset.bounds.top, resolution=wanted,
    )  # fmt: skip
    # Pixel corners at whole multiples of the GSD: two runs on overlapping DEMs then differ by whole pixels only.
    transform = Affine(
        wanted, 0, wanted * round(transform.c / wanted), 0, -wanted, wanted * round(transform.f / wanted)
    )
    coarser = wanted > 1.5 * native
    return Plan(
        Grid(crs.to_wkt(), transform, height, width, radius),
        None,
        Resampling.average if coarser else Resampling.cubic,
        holds_radii,
    )


def _holds_radii(dem: Path, dataset: DatasetReader, radius: float, progress: Progress) -> bool:
    """Whether the DEM holds radii from the body's centre. Raises InputError where its numbers cannot be metres."""
    size = 256
    windows = [
        Window(c, r, min(size, dataset.width - c), min(size, dataset.height - r))
        for r in np.unique(np.linspace(0, max(0, dataset.height - size), 5).astype(int))
        for c in np.unique(np.linspace(0, max(0, dataset.width - size), 5).astype(int))
    ]
    samples = [rasters.read_window(dataset, w) for w in windows]
    finite = np.concatenate([s[np.isfinite(s)] for s in samples])
    if not finite.size:  # a DEM of mostly nodata: the first values anywhere tell heights from radii
        samples = [_first_elevations(dem, dataset, progress)]
        finite = samples[0][np.isfinite(samples[0])]
    middle = float(np.median(finite))
    if abs(middle) > 0.5 * radius:
        if abs(middle - radius) > 0.05 * radius:
            raise InputError(
                f"{dem}: expected metres above the sphere or radii near {radius:g} m, found values near {middle:g}; check units and `body`."
            )
        return True
    kilometres_radius = (
        abs(middle - radius / 1000) < 0.05 * radius / 1000 and float(np.ptp(finite)) < 0.02 * radius / 1000
    )
    if kilometres_radius:
        raise InputError(
            f"{dem}: expected metres, found values near {middle:g}, the body's radius in kilometres; multiply by 1000."
        )
    east, north = rasters.pixel_size_at(dataset, radius, dataset.height / 2, dataset.width / 2)
    rise = np.concatenate(
        [np.abs(np.diff(s, axis=1)).ravel() for s in samples if s.shape[1] > 1] or [np.array([np.nan])]
    )
    rise = rise[np.isfinite(rise)]
    if rise.size > 100:
        slope = math.degrees(math.atan(float(np.sqrt(np.mean(rise**2))) / min(east, north)))
        if slope > 80:
            raise InputError(
                f"{dem}: expected elevations in metres, found an rms slope of {slope:.1f} deg; are the units smaller than metres?"
            )
        if 0 < slope < 0.02:
            raise InputError(
                f"{dem}: expected elevations in metres, found an rms slope of {slope:.4f} deg; are they in kilometres?"
            )
    return False


def _first_elevations(dem: Path, dataset: DatasetReader, progress: Progress) -> NDArray[np.float64]:
    """The first block of a raster that holds any value. Raises InputError where none does."""
    rows, cols = dataset.block_shapes[0]
    down, across = math.ceil(dataset.height / rows), math.ceil(dataset.width / cols)
    for r in range(down):
        progress(r, down, "rows of blocks without elevations")
        for c in range(across):
            # a sparse GeoTIFF leaves out blocks of nodata: these need not be read
            if dataset.driver == "GTiff" and not dataset.get_tag_item(f"BLOCK_OFFSET_{c}_{r}", "TIFF", bidx=1):
                continue
            window = Window(
                c * cols, r * rows, min(cols, dataset.width - c * cols), min(rows, dataset.height - r * rows)
            )
            values = rasters.read_window(dataset, window)
            if np.isfinite(values).any():
                return values
    raise InputError(f"{dem}: expected elevations, found only nodata; is this the right band and file?")
