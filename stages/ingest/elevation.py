"""Elevations on the working grid, read and written piece by piece."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.windows import Window

from schemas import ArtefactError, ArtefactWriter, InputError
from stages.common.progress import Progress
from stages.ingest.config import Config
from stages.ingest.plan import Plan
from stages.physics.maps import rasters
from stages.physics.maps.grid import Grid

STRIP_PX = 4096  # a raster with wider blocks than this is stored in strips
STRIP_CACHE = 96 << 20  # bytes of strips that stay in GDAL's cache
LOWEST_PIECE = 16  # rows
MINIMUM_COVERAGE = 0.5  # share of a coarse pixel that must be valid before its mean counts


def area_mean(fine: NDArray, factor: int) -> NDArray[np.float32]:
    """Mean over factor x factor pixels, NaN where less than half is valid.

    fine : (H * factor, W * factor), NaN = nodata -> (H, W)
    """
    if factor == 1:
        return fine.astype(np.float32)
    height, width = fine.shape[0] // factor, fine.shape[1] // factor
    cells = fine[: height * factor, : width * factor].reshape(height, factor, width, factor)
    valid = np.isfinite(cells)
    count = valid.sum(axis=(1, 3))
    total = np.where(valid, cells, 0).sum(axis=(1, 3))
    enough = count >= MINIMUM_COVERAGE * factor * factor
    return np.where(enough, total / np.maximum(count, 1), np.nan).astype(np.float32)


def write_elevation(
    dem: Path, dataset: DatasetReader, plan: Plan, config: Config, writer: ArtefactWriter, progress: Progress
) -> tuple[int, float, float]:
    """Resample the DEM onto the grid in pieces; returns the number of valid pixels, least and largest elevation, m."""
    grid = plan.grid
    elevation, dem_valid = writer.dataset("elevation"), writer.dataset("dem_valid")
    first, last = writer.file.attrs.get("shard_rows", (0, grid.height))
    todo = [b for b in _pieces(dataset, grid, config) if first <= b[0] < last]
    seen, low, high = 0, math.inf, -math.inf
    for number, (row, col, height, width) in enumerate(todo):
        progress(number, len(todo), "DEM blocks")
        if plan.factor:
            values = _read_means(dataset, plan, plan.factor, (row, col, height, width))
        else:
            values, valid = rasters.warp(dataset, grid.window(row, col, height, width), plan.resampling)
            values[~valid] = np.nan
            if plan.holds_radii:
                values = (values.astype(np.float64) - grid.radius).astype(np.float32)
        good = np.isfinite(values)
        elevation[row : row + height, col : col + width] = values
        dem_valid[row : row + height, col : col + width] = good
        if good.any():
            seen += int(good.sum())
            low, high = min(low, float(values[good].min())), max(high, float(values[good].max()))
    progress(len(todo), len(todo), "DEM blocks")
    if not seen and config.shard[1] == 1:
        raise InputError(f"{dem}: expected elevations, found only nodata on the grid at {grid.gsd:g} m.")
    return seen, low, high


def _pieces(dataset: DatasetReader, grid: Grid, config: Config) -> Iterator[tuple[int, int, int, int]]:
    """(row, col, height, width) of the pieces that are worked on at a time; none crosses a multiple of
    ``config.block``.

    A DEM that is stored in wide strips is cut into low pieces: GDAL's cache then holds the strips until the last piece
    of the row is done. With higher pieces it would read the strips again for each of them.
    """
    height, (_, strip) = config.block, dataset.block_shapes[0]
    if strip > STRIP_PX:
        rows_of_dem = STRIP_CACHE // (strip * np.dtype(dataset.dtypes[0]).itemsize)
        height = min(height, max(LOWEST_PIECE, int(rows_of_dem * grid.height / dataset.height)))
    for top in range(0, grid.height, config.block):
        rows = min(config.block, grid.height - top)
        for row in range(0, rows, height):
            for col in range(0, grid.width, config.block):
                yield top + row, col, min(height, rows - row), min(config.block, grid.width - col)


def _read_means(dataset: DatasetReader, plan: Plan, n: int, piece: tuple[int, int, int, int]) -> NDArray[np.float32]:
    """Means of n x n pixels over a piece of the grid, read in parts that fit the memory however large n is."""
    row, col, height, width = piece
    values = np.empty((height, width), np.float32)
    step = max(1, rasters.LARGEST_WINDOW // (width * n * n))
    for r in range(0, height, step):
        h = min(step, height - r)
        block = rasters.read_window(dataset, Window(col * n, (row + r) * n, width * n, h * n))
        if plan.holds_radii:
            block -= plan.grid.radius
        values[r : r + h] = area_mean(block, n)
    return values


def reuse_elevation(
    scene: Path, file: h5py.File, view: bool, writer: ArtefactWriter, progress: Progress
) -> tuple[int, float, float]:
    """Copy the elevations of another scene, or, as a ``view``, link to them: shards, which may be hundreds, do that."""
    for name in ("elevation", "dem_valid"):
        whole = (slice(None), slice(None))
        if view:
            writer.link(name, [(whole, file[name], whole)])
            continue
        target = writer.dataset(name)
        for row in range(0, target.shape[0], 256):
            target[row : row + 256] = file[name][row : row + 256]
    if "elevation_low_m" not in file.attrs:
        raise ArtefactError(
            f"{scene}: expected the extremes of its elevations, found none; run 'lunargr ingest' again."
        )
    return (
        int(file.attrs["dem_valid_px"]),
        float(file.attrs["elevation_low_m"]),
        float(file.attrs["elevation_high_m"]),
    )
