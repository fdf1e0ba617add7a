"""infer: coefficient maps for a DEM of any size, the same wherever the windows fall, in bounded memory.

Every window is read with a halo as wide as the network can see, and starts on the lattice of the network's pooling. Its
inner part is then exactly what one pass over the whole map would give: no squares at window borders.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from schemas import (
    SCENE,
    SVBRDF,
    ArtefactError,
    ArtefactWriter,
    ConfigError,
    atomic_path,
    check_output,
    open_artefact,
    read_strings,
)
from schemas.hdf5 import silence_hdf5
from stages.network.normalisation import FILL_REACH, fill_holes
from stages.network.predictor import Predictor, choose_device, load_predictor
from stages.network.runtime import choose_inference_precision, keep_freed_memory
from stages.physics.geotiff import write_geotiff
from stages.physics.grid import Grid, read_grid

Progress = Callable[[int, int, str], None]

QUANTITY = "radiance factor I/F = pi r, including cos(incidence)"
GSD_TOLERANCE = 0.05  # relative; beyond it the network would meet terrain at a scale it never saw


@dataclass(frozen=True)
class Config:
    """window, stride : px; windows overlap by their difference and are blended; offset : px, shifts their grid;
    precision : fp32, bf16, or auto (see ``stages.network.runtime.choose_inference_precision``).
    """

    window: int = 1024
    stride: int | None = None
    offset: int = 0
    device: str = "auto"
    precision: str = "fp32"
    any_gsd: bool = False
    shard: tuple[int, int] = (0, 1)


@dataclass(frozen=True)
class Summary:
    """Ranges of the coefficients, for the table at the end: name -> (mean, std, 1 %, 99 %)."""

    grid: Grid
    model: str
    valid_share: float
    windows: int
    coefficients: dict[str, tuple[float, float, float, float]]


def run(
    scene: Path,
    checkpoint: Path,
    output: Path,
    config: Config,
    geotiff: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Summary:
    """Write ``svbrdf.h5`` and, beside it or at ``geotiff``, a cloud-optimised GeoTIFF. Raises ConfigError, ArtefactError."""
    stride = _stride(config)
    tiff = geotiff or output.with_suffix(".tif")
    check_output(output, [scene, checkpoint], overwrite)
    check_output(tiff, [scene, checkpoint, output], overwrite)
    device = choose_device(config.device)
    keep_freed_memory()
    predictor = load_predictor(checkpoint, device)
    precision = config.precision
    # A shard holds some rows only; the GeoTIFF is made of the merged whole.
    whole = config.shard[1] == 1
    with open_artefact(scene, SCENE) as file:
        grid = read_grid(file, scene)
        if not config.any_gsd and abs(grid.gsd - predictor.gsd) > GSD_TOLERANCE * predictor.gsd:
            raise ConfigError(
                f"{scene}: expected a grid near {predictor.gsd:g} m, at which {checkpoint} was trained, found {grid.gsd:g} m; "
                "ingest the DEM at that --gsd or add --any-gsd."
            )
        if precision == "auto":
            precision = choose_inference_precision(predictor, _sample_of(file), device)
        names = [p.name for p in predictor.model.parameters]
        sizes = {"coefficient": len(names), "y": grid.height, "x": grid.width}
        attributes = {
            "gsd_m": grid.gsd,
            "body_radius_m": grid.radius,
            "model": predictor.model.name,
            "quantity": QUANTITY,
            "precision": precision,
        }
        with ArtefactWriter(
            output,
            SVBRDF,
            sizes,
            config=asdict(config),
            inputs=[scene, checkpoint],
            attributes=attributes,
            overwrite=overwrite,
        ) as writer:
            writer.write_crs(grid.crs_wkt, grid.transform)
            writer.write("x", file["x"][...])
            writer.write("y", file["y"][...])
            writer.write("coefficient_name", names)
            windows = _predict(file, writer, predictor, replace(config, precision=precision), stride, device, progress)
            share, ranges = _statistics(writer.file, names)
            if whole:
                with atomic_path(tiff) as partial:
                    write_geotiff(partial, writer.file, grid)
    return Summary(grid, predictor.model.name, share, windows, ranges)


def _stride(config: Config) -> int:
    stride = config.stride or config.window  # windows carry their context: they need no overlap
    if config.window < 16 or not 1 <= stride <= config.window:
        raise ConfigError(
            f"--window and --stride: expected 1 <= stride <= window and window >= 16, found {stride} and {config.window}."
        )
    return stride


def count_bands(scene: Path, config: Config) -> int:
    """Rows of windows on a scene: more shards than these have nothing to do."""
    stride = _stride(config)
    with open_artefact(scene, SCENE) as file:
        return len(axis_windows(file["elevation"].shape[0], config.window, stride, config.offset))


def summarise(svbrdf: Path, windows: int = 0) -> Summary:
    """What a map holds, for the table at the end."""
    with open_artefact(svbrdf, SVBRDF) as file:
        share, ranges = _statistics(file, read_strings(file, "coefficient_name"))
        return Summary(read_grid(file, svbrdf), str(file.attrs["model"]), share, windows, ranges)


def axis_windows(length: int, window: int, stride: int, offset: int) -> list[tuple[int, int]]:
    """(first, last) of the windows along one axis; they cover 0 .. length and overlap by window - stride."""
    start = (offset % stride) - stride if offset % stride else 0
    found = []
    while True:
        first, last = max(0, start), min(length, start + window)
        if last > first:
            found.append((first, last))
        if start + window >= length:
            return found
        start += stride


def blend_weights(first: int, last: int, overlap: int, length: int) -> NDArray[np.float32]:
    """Weights of a window along one axis: linear ramps over the overlap with its neighbours, 1 elsewhere."""
    position = np.arange(first, last, dtype=np.float32) + 0.5
    weight = np.ones(last - first, np.float32)
    if overlap > 0:
        if first > 0:
            weight = np.minimum(weight, (position - first) / overlap)
        if last < length:
            weight = np.minimum(weight, (last - position) / overlap)
    return np.maximum(weight, 1e-4)


def _predict(
    file: h5py.File,
    writer: ArtefactWriter,
    predictor: Predictor,
    config: Config,
    stride: int,
    device: torch.device,
    progress: Progress | None,
) -> int:
    """Run the network over all windows, one row of windows at a time; only that row's sums are kept in memory."""
    elevation, dem_valid = file["elevation"], file["dem_valid"]
    height, width = elevation.shape
    overlap = config.window - stride
    rows = axis_windows(height, config.window, stride, config.offset)
    cols = axis_windows(width, config.window, stride, config.offset)
    first_band, last_band = (len(rows) * k // config.shard[1] for k in (config.shard[0], config.shard[0] + 1))
    coefficients, valid, copied = writer.dataset("coefficients"), writer.dataset("valid"), writer.dataset("elevation")
    channels = coefficients.shape[0]
    # A shard owns the rows from its first window's start to the next shard's; windows around them are worked on as well.
    own_first = rows[first_band][0] if first_band < len(rows) else height
    own_last = rows[last_band][0] if last_band < len(rows) else height
    if config.shard[0] == 0:
        own_first = 0
    if config.shard[1] > 1:
        writer.file.attrs["shard_rows"] = np.array([own_first, own_last], np.int64)
    bands = [k for k, (a, b) in enumerate(rows) if b > own_first and a < own_last]
    total = np.zeros((channels, 0, width), np.float32)
    weight = np.zeros((0, width), np.float32)
    top, done = own_first, 0
    boxes = [(*rows[k], *columns) for k in bands for columns in cols]
    found = _in_order(
        boxes,
        lambda r0, r1, c0, c1: predict_window(
            elevation, dem_valid, predictor, (r0, c0, r1 - r0, c1 - c0), device, config.precision
        ),
        # two windows at a time keep reading and small layers from leaving cores idle; of float32, memory holds one
        2 if device.type == "cpu" and config.precision == "bf16" else 1,
    )
    for place, band in enumerate(bands):
        r0, r1 = rows[band]
        if not overlap:
            copied[r0:r1] = elevation[r0:r1]
            top = r1
        # Rows above this band get no more contributions: write them and let go of them.
        if overlap and r0 > top:
            _flush(total, weight, top, r0, own_first, own_last, elevation, dem_valid, coefficients, valid, copied)
            total, weight, top = total[:, r0 - top :], weight[r0 - top :], r0
        if overlap and r1 > top + weight.shape[0]:
            grow = r1 - top - weight.shape[0]
            total = np.concatenate([total, np.zeros((channels, grow, width), np.float32)], axis=1)
            weight = np.concatenate([weight, np.zeros((grow, width), np.float32)])
        for (c0, c1), values in zip(cols, itertools.islice(found, len(cols)), strict=True):
            if progress:
                progress(done, len(bands) * len(cols), "windows")
            done += 1
            if values is None:
                continue
            if not overlap:
                _write_window(values, r0, c0, dem_valid, coefficients, valid)
                continue
            w = blend_weights(r0, r1, overlap, height)[:, None] * blend_weights(c0, c1, overlap, width)
            skip = max(0, top - r0)  # a shard's first band may begin above its rows
            total[:, r0 + skip - top : r1 - top, c0:c1] += (values * w)[:, skip:]
            weight[r0 + skip - top : r1 - top, c0:c1] += w[skip:]
        if overlap and place == len(bands) - 1:
            _flush(
                total,
                weight,
                top,
                top + weight.shape[0],
                own_first,
                own_last,
                elevation,
                dem_valid,
                coefficients,
                valid,
                copied,
            )
    if progress:
        progress(done, done, "windows")
    return done


def _in_order(
    boxes: Sequence[tuple[int, int, int, int]],
    work: Callable[[int, int, int, int], NDArray[np.float32] | None],
    together: int,
) -> Iterator[NDArray[np.float32] | None]:
    """What ``work`` makes of each box, in their order, ``together`` at a time, which share PyTorch's threads."""
    threads = torch.get_num_threads()
    together = max(1, min(together, threads))
    torch.set_num_threads(threads // together)
    try:
        with ThreadPoolExecutor(together) as pool:
            waiting: deque[Future[NDArray[np.float32] | None]] = deque()
            try:
                for box in boxes:
                    waiting.append(pool.submit(work, *box))
                    if len(waiting) > together:  # while one is written, the others go on
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                for job in waiting:
                    job.cancel()
    finally:
        torch.set_num_threads(threads)


def _sample_of(scene: h5py.File, size: int = 256) -> Tensor:
    """A window of terrain from the middle of a scene, holes filled."""
    height, width = scene["elevation"].shape
    r0, c0 = max(0, (height - size) // 2), max(0, (width - size) // 2)
    part = np.s_[r0 : r0 + size, c0 : c0 + size]
    return torch.from_numpy(fill_holes(scene["elevation"][part], scene["dem_valid"][part].astype(bool)))


def predict_window(
    elevation: Any,
    dem_valid: Any,
    predictor: Predictor,
    window: tuple[int, int, int, int],
    device: torch.device,
    precision: str = "fp32",
) -> NDArray[np.float32] | None:
    """Coefficients (C, h, w) of the window (row, col, h, w), with all the context that the network can see.

    None where the window holds no valid DEM.
    """
    row, col, h, w = window
    height, width = elevation.shape
    if not dem_valid[row : row + h, col : col + w].any():
        return None
    lattice = predictor.net.stride
    # Outside the map edges are continued by the network's own padding, as at the edges of training crops.
    reach = predictor.net.reach
    r0, c0 = max(0, (row - reach) // lattice * lattice), max(0, (col - reach) // lattice * lattice)
    r1 = min(height, math.ceil((row + h + reach) / lattice) * lattice)
    c1 = min(width, math.ceil((col + w + reach) / lattice) * lattice)
    fr0, fc0, fr1, fc1 = (
        max(0, r0 - FILL_REACH),
        max(0, c0 - FILL_REACH),
        min(height, r1 + FILL_REACH),
        min(width, c1 + FILL_REACH),
    )
    valid = dem_valid[fr0:fr1, fc0:fc1].astype(bool)
    terrain = fill_holes(elevation[fr0:fr1, fc0:fc1], valid)[r0 - fr0 : r1 - fr0, c0 - fc0 : c1 - fc0]
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
        out = predictor.part(torch.from_numpy(np.ascontiguousarray(terrain)).to(device), (row - r0, col - c0, h, w))
    return out.float().cpu().numpy()


def _flush(
    total: NDArray,
    weight: NDArray,
    top: int,
    bottom: int,
    own_first: int,
    own_last: int,
    elevation: Any,
    dem_valid: Any,
    *outputs: h5py.Dataset,
) -> None:
    coefficients, valid, copied = outputs
    a, b = max(top, own_first), min(bottom, own_last)
    if b <= a:
        return
    part = slice(a - top, b - top)
    mask = dem_valid[a:b].astype(bool)
    known = mask & (weight[part] > 0)
    values = np.where(known, total[:, part] / np.maximum(weight[part], 1e-12), np.nan)
    coefficients[:, a:b] = values
    valid[a:b] = known
    copied[a:b] = elevation[a:b]


def _write_window(
    values: NDArray[np.float32],
    row: int,
    col: int,
    dem_valid: Any,
    coefficients: h5py.Dataset,
    valid: h5py.Dataset,
) -> None:
    """A window that no other touches."""
    part = np.s_[row : row + values.shape[1], col : col + values.shape[2]]
    mask = dem_valid[part].astype(bool)
    if not mask.all():
        values[:, ~mask] = np.nan
    coefficients[(slice(None), *part)] = values
    valid[part] = mask


def _statistics(file: h5py.File, names: list[str]) -> tuple[float, dict[str, tuple[float, float, float, float]]]:
    """Mean, std and percentiles from at most half a million pixels, read in strips."""
    height, width = file["valid"].shape
    step = max(1, math.ceil(math.sqrt(height * width / 5e5)))
    share = float(np.mean([file["valid"][r, :].mean() for r in range(0, height, max(1, height // 256))]))
    ranges = {}
    for k, name in enumerate(names):
        sample = np.concatenate([file["coefficients"][k, r, ::step] for r in range(0, height, step)])
        sample = sample[np.isfinite(sample)]
        if sample.size:
            low, high = np.percentile(sample, [1, 99])
            ranges[name] = (float(sample.mean()), float(sample.std()), float(low), float(high))
        else:
            ranges[name] = (math.nan, math.nan, math.nan, math.nan)
    return share, ranges


def open_terrain(path: Path) -> bool:
    """Whether ``path`` is one of our HDF5 artefacts (otherwise a raster DEM)."""
    silence_hdf5()
    if not path.exists():
        raise ArtefactError(f"{path}: no such file; expected scene.h5 or a DEM.")
    return bool(h5py.is_hdf5(path)) and _names_schema(path)


def _names_schema(path: Path) -> bool:
    try:
        with h5py.File(path, "r") as file:
            return "lunargr_schema" in file.attrs
    except OSError:
        return True  # damaged: let open_artefact say so
