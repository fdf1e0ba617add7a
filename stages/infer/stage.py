"""infer: coefficient maps for a DEM of any size, the same wherever the windows fall, in bounded memory.

Every window has as much context around it as the network can see, and lies on the lattice of the network's pooling. It is
then exactly what one pass over the whole map would give: no squares at window borders.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np
import torch
from numpy.typing import NDArray

from schemas import CHECKPOINT, SCENE, SVBRDF, ArtefactWriter, ConfigError, atomic_path, open_artefact, read_strings
from schemas.files.outputs import Output
from stages import merge
from stages.common.brightness import QUANTITIES
from stages.common.memory import keep_freed_memory, return_freed_memory
from stages.common.progress import Progress
from stages.common.runner.job import Job
from stages.common.runner.stage import as_geotiff
from stages.infer.config import Config
from stages.infer.parallel import run_in_threads
from stages.infer.terrain import TerrainReader, valid_part
from stages.infer.windows import Box, check_window, list_windows, shard_rows, window_rows
from stages.infer.writing import MapWriter
from stages.network.mapper import Mapper
from stages.network.precision import check_precision, choose_inference_precision
from stages.network.predictor import choose_device, load_predictor
from stages.pairs.ground import Ground
from stages.pairs.holes import fill_holes
from stages.physics.maps.geotiff import MapTiff, band_names, map_tags
from stages.physics.maps.grid import Grid, read_grid

BANDS = 8  # rows of windows in one shard
SAMPLE = 256  # px, edge of the terrain by which the precision is chosen
GSD_TOLERANCE = 0.05  # relative; beyond it terrain has another scale than the network was trained at


@dataclass(frozen=True)
class Summary:
    """Ranges of the coefficients, for the table at the end: name -> (mean, std, 1 %, 99 %)."""

    grid: Grid
    model: str
    valid_share: float
    windows: int
    coefficients: dict[str, tuple[float, float, float, float]]


def work(scene: Path, checkpoint: Path, output: Output, config: Config, progress: Progress) -> Summary:
    """See :func:`stages.infer.run`."""
    check_window(config)
    check_precision(config.precision)
    device = choose_device(config.device)
    keep_freed_memory()
    predictor = load_predictor(checkpoint, device)
    with open_artefact(checkpoint, CHECKPOINT) as trained:
        ground = Ground.read(trained)
    precision = config.precision
    with open_artefact(scene, SCENE) as file:
        grid = read_grid(file, scene)
        if not config.any_gsd and abs(grid.gsd - predictor.gsd) > GSD_TOLERANCE * predictor.gsd:
            raise ConfigError(
                f"{scene}: expected a grid near {predictor.gsd:g} m, at which {checkpoint} was trained, found {grid.gsd:g} m; "
                "ingest the DEM at that `gsd` or add `any_gsd`."
            )
        if precision == "auto":
            precision = choose_inference_precision(predictor, _read_sample(file), device)
        names = [p.name for p in predictor.model.parameters]
        maps = list(predictor.maps.maps) if predictor.maps.channels > len(predictor.maps.maps) else []
        sizes = {"coefficient": len(names), "map": len(maps), "y": grid.height, "x": grid.width}
        if ground is not None:
            sizes |= ground.sizes
        attributes = {
            "gsd_m": grid.gsd,
            "body_radius_m": grid.radius,
            "model": predictor.model.name,
            "quantity": QUANTITIES[predictor.image_units],
            "image_units": predictor.image_units,
            "precision": precision,
        } | ({} if ground is None else ground.attributes)
        if math.isfinite(predictor.image_noise):
            attributes["image_noise"] = predictor.image_noise
        with contextlib.ExitStack() as stack:
            writer = stack.enter_context(
                ArtefactWriter(
                    output.file,
                    SVBRDF,
                    sizes,
                    config=asdict(config),
                    inputs=[scene, checkpoint],
                    attributes=attributes,
                )
            )
            writer.write_crs(grid.crs_wkt, grid.transform)
            writer.write("x", file["x"][...])
            writer.write("y", file["y"][...])
            writer.write("coefficient_name", names)
            if ground is not None:
                ground.write(writer)
            if maps:
                writer.write("map_name", maps)
                writer.dataset("coefficients_std")
            mapper = Mapper(predictor, device, precision, torch.get_num_threads(), deviations=bool(maps))
            picture = None
            if as_geotiff(config):
                partial = stack.enter_context(atomic_path(output.geotiff_path))
                bands = band_names(names, maps)
                tags = map_tags(bands, writer.file.attrs)
                picture = stack.enter_context(MapTiff(partial, grid, bands, tags, ["1"] * len(bands)))
            windows = _predict(file, writer, picture, mapper, config, progress)
            share, ranges = _statistics(writer.file, names)
    return Summary(grid, predictor.model.name, share, windows, ranges)


def in_parts(job: Job, scene: Path, checkpoint: Path, config: Config) -> Summary:
    """The map from shards of its rows. scene : as it lies there; the job's inputs may be the DEM that it was made of"""
    pieces = job.shards("map", [scene, checkpoint], config, _count_bands(scene, config), BANDS)
    whole = Output(job.output.file, overwrite=True, geotiff=job.output.geotiff)
    merge.run(pieces, whole, merge.Config(inputs=tuple(job.inputs)), progress=job.progress)
    return summarise(job.output.file, len(pieces))


def _count_bands(scene: Path, config: Config) -> int:
    """Rows of windows on a scene: more shards than these have nothing to do."""
    with open_artefact(scene, SCENE) as file:
        return len(window_rows(file["elevation"].shape[0], config))


def summarise(svbrdf: Path, windows: int = 0) -> Summary:
    """What a map holds, for the table at the end."""
    with open_artefact(svbrdf, SVBRDF) as file:
        share, ranges = _statistics(file, read_strings(file, "coefficient_name"))
        return Summary(read_grid(file, svbrdf), str(file.attrs["model"]), share, windows, ranges)


def _predict(
    file: h5py.File,
    writer: ArtefactWriter,
    picture: MapTiff | None,
    mapper: Mapper,
    config: Config,
    progress: Progress,
) -> int:
    """Run the network over all windows of the shard's rows; returns the number of windows."""
    elevation, dem_valid = file["elevation"], file["dem_valid"]
    own = shard_rows(elevation.shape[0], config)
    if config.shard[1] > 1:
        writer.file.attrs["shard_rows"] = np.array(own, np.int64)
    boxes = list_windows(elevation.shape, config, mapper.together)

    def work(box: Box) -> Iterator[tuple[int, int, NDArray[np.float32]]]:
        part = valid_part(dem_valid, box)
        if part is not None:
            for row, values in mapper.strips(TerrainReader(elevation, dem_valid), elevation.shape, part):
                yield row, part[1], values
        return_freed_memory()  # or what windows of other sizes leave behind would grow with the map

    outputs = MapWriter(writer, elevation, dem_valid, own, picture)
    rows, done = sum(box[2] for box in boxes), 0
    for _, strip in run_in_threads(boxes, work, mapper.together):
        progress(min(done, rows), rows, "rows of windows")
        if strip is None:
            continue
        row, col, values = strip
        done += values.shape[1]
        outputs.put(row, col, values)
        outputs.copy_elevation()
    while outputs.copy_elevation():
        pass
    progress(rows, rows, "rows of windows")
    return len(boxes)


def _read_sample(scene: h5py.File) -> NDArray[np.float32]:
    """A window of terrain from the middle of a scene, holes filled."""
    height, width = scene["elevation"].shape
    r0, c0 = max(0, (height - SAMPLE) // 2), max(0, (width - SAMPLE) // 2)
    part = np.s_[r0 : r0 + SAMPLE, c0 : c0 + SAMPLE]
    return fill_holes(scene["elevation"][part], scene["dem_valid"][part].astype(bool))


def _statistics(file: h5py.File, names: list[str]) -> tuple[float, dict[str, tuple[float, float, float, float]]]:
    """Mean, std and percentiles from at most half a million pixels, in few rows: each touches a chunk every 256 pixels."""
    height, width = file["valid"].shape
    rows = range(0, height, max(1, height // 64))
    step = max(1, math.ceil(len(rows) * width / 5e5))
    share = float(np.mean([file["valid"][r, :].mean() for r in rows]))
    ranges = {}
    for k, name in enumerate(names):
        sample = np.concatenate([file["coefficients"][k, r, :][::step] for r in rows])
        sample = sample[np.isfinite(sample)]
        if sample.size:
            low, high = np.percentile(sample, [1, 99])
            ranges[name] = (float(sample.mean()), float(sample.std()), float(low), float(high))
        else:
            ranges[name] = (math.nan, math.nan, math.nan, math.nan)
    return share, ranges
