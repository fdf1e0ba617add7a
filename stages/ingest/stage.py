"""ingest: a DEM on a metric grid at the working GSD, and the valid ground that each image shows.

Everything streams in blocks: memory does not grow with the DEM.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas import (
    SCENE,
    ArtefactWriter,
    ConfigError,
    GeometryError,
    InputError,
    open_artefact,
    read_config,
)
from schemas.files.outputs import Output
from schemas.reading import is_artefact
from stages import merge
from stages.common.progress import Progress, Say
from stages.common.runner.job import Job
from stages.common.shards import shard_range
from stages.ingest.config import Config
from stages.ingest.elevation import reuse_elevation, write_elevation
from stages.ingest.plan import plan_grid
from stages.ingest.validity import check_frames, hash_files, write_validity
from stages.physics.bodies.spheres import Body, find_body
from stages.physics.images.table import Frame, load_frames, read_frames, relative_path, write_frames
from stages.physics.images.table_checks import check_distinct, check_table
from stages.physics.maps import rasters
from stages.physics.maps.grid import Grid, crs_radius, read_grid, require_crs

BANDS = 8  # rows of blocks of a DEM in one shard: some minutes of work on real data
SMALLEST_CROP = 16  # px
LARGEST_CROP = 8192  # px: what a network can see at once, and more


@dataclass(frozen=True)
class Summary:
    """What ingest found, for the table at the end. elevation_range : (least, largest) m, NaN where all is nodata;
    blank : images without a valid pixel on the DEM
    """

    grid: Grid
    dem_valid_share: float
    elevation_range: tuple[float, float]
    frames: tuple[Frame, ...]
    valid_area_km2: tuple[float, ...]
    resampled: bool
    skipped: tuple[str, ...]
    blank: tuple[Frame, ...] = ()


def work(dem: Path, images: Path | None, output: Output, config: Config, say: Say, progress: Progress) -> Summary:
    """See :func:`stages.ingest.run`."""
    if config.crop < SMALLEST_CROP or config.crop % 2 or config.crop > LARGEST_CROP:
        raise ConfigError(
            f"`crop`: expected an even number of pixels, {SMALLEST_CROP} .. {LARGEST_CROP}; found {config.crop}."
        )
    body = find_body(config.body)
    frames = read_frames(images, body) if images else []
    if images and not config.trust_table:
        for sentence in check_table(images, frames, body):
            say(f"warning: {sentence}")
    alone = config.shard[1] == 1
    with _open_terrain(dem, images, config, body, progress, say) as terrain:
        mine, skipped = check_frames(
            frames[slice(*shard_range(len(frames), config.shard))], terrain.grid, config.skip_outside, say
        )
        if frames and not mine and alone:
            raise InputError(
                "no image touches the DEM; check that images and DEM show the same place (longitudes, body, CRS)."
            )
        sizes = {"frame": len(mine), "y": terrain.grid.height, "x": terrain.grid.width, "window": 4}
        with ArtefactWriter(
            output.file,
            SCENE,
            sizes,
            config=terrain.config,
            inputs=[dem] + ([images] if images else []),
            attributes=terrain.attributes
            | {
                "crop_px": np.int32(config.crop),
                "elevation_source": relative_path(terrain.source, output.file.resolve().parent),
            },
        ) as writer:
            _write_grid(writer, terrain.grid)
            known, low, high = terrain.write(writer, progress)
            writer.file.attrs["dem_valid_px"] = known
            if known:  # a shard may lie wholly on nodata
                writer.file.attrs["elevation_low_m"], writer.file.attrs["elevation_high_m"] = low, high
            for name in ("valid", "frame_window"):  # also where there is no image at all
                writer.dataset(name)
            elevation = terrain.file or writer.file
            areas = [
                write_validity(
                    f, k, terrain.grid, (low, high), elevation, writer, config, _overall(progress, k, len(mine))
                )
                for k, f in enumerate(mine)
            ]
            progress(len(mine), len(mine), "image masks")
            if frames and alone:
                _check_shown(images, areas)
            writer.write("valid_area_m2", np.array(areas))
            hashed = [hash_files(frame) for frame in mine]
            check_distinct(hashed)
            write_frames(writer, hashed)
    return summarise(output.file, tuple(skipped))


def in_parts(job: Job, dem: Path, images: Path | None, config: Config) -> Summary:
    """The scene from shards of the DEM's rows, and then from shards of its images on the grid that these give."""
    output = Output(job.output.file, overwrite=True)
    made_of = merge.Config(inputs=tuple(job.inputs))
    grid = dem
    if not is_artefact(dem):
        pieces = job.shards("dem", [dem, None], config, _count_bands(dem, config), BANDS)
        if images is None:
            merge.run(pieces, output, made_of, progress=job.progress)
            return summarise(output.file)
        grid = job.file("grid.h5")
        merge.run(pieces, Output(grid, overwrite=True), merge.Config(virtual=True, inputs=(dem,)))
    names = [frame.image_id for frame in read_frames(images, find_body(config.body))] if images else []
    pieces = job.shards("images", [grid, images], replace(config, gsd=None), len(names))
    areas = []
    for piece in pieces:
        with open_artefact(piece, SCENE) as file:
            areas += file["valid_area_m2"][...].tolist()
    _check_shown(images, areas)
    merge.run(pieces, output, made_of, progress=job.progress)
    found = summarise(output.file)
    kept = {frame.image_id for frame in found.frames}
    return replace(found, skipped=tuple(name for name in names if name not in kept))


def _overall(progress: Progress, index: int, count: int) -> Progress:
    """What one image among ``count`` reports its progress to, as a share of all of them."""
    return lambda done, total, what: progress(1000 * index + 1000 * done // max(1, total), 1000 * count, what)


def summarise(scene: Path, skipped: tuple[str, ...] = ()) -> Summary:
    """What a scene holds, for the table at the end."""
    with open_artefact(scene, SCENE) as file:
        grid = read_grid(file, scene)
        low, high = (file.attrs.get(k, math.nan) for k in ("elevation_low_m", "elevation_high_m"))
        frames = tuple(load_frames(file, scene))
        return Summary(
            grid,
            float(file.attrs["dem_valid_px"]) / (grid.height * grid.width),
            (float(low), float(high)),
            frames,
            tuple(float(a) / 1e6 for a in file["valid_area_m2"][...]),
            bool(read_config(file)["resampled"]),
            skipped,
            tuple(f for f, window in zip(frames, file["frame_window"][...], strict=True) if not window[2]),
        )


@dataclass(frozen=True)
class Terrain:
    """The source of the scene's elevations.

    source : the DEM file; write : writes them; returns the number of valid pixels, the least and the largest elevation, m
    """

    source: Path
    grid: Grid
    config: dict[str, Any]
    attributes: dict[str, Any]
    write: Callable[[ArtefactWriter, Progress | None], tuple[int, float, float]]
    file: h5py.File | None = None  # to read them from while the output is written, where they are only linked there


@contextlib.contextmanager
def _open_terrain(
    dem: Path, images: Path | None, config: Config, body: Body, progress: Progress, say: Say
) -> Iterator[Terrain]:
    count = config.shard[1]
    if is_artefact(dem):
        if images is None:
            raise ConfigError(f"{dem}: a scene already; add `images`, or give a DEM that GDAL reads.")
        with open_artefact(dem, SCENE) as file:
            grid = read_grid(file, dem)
            if abs(grid.radius - body.radius) > 1e-6 * body.radius:
                raise ConfigError(f"{dem}: its body has a radius of {grid.radius:g} m; give the same `body`.")
            if config.gsd is not None and abs(config.gsd - grid.gsd) > 1e-3 * grid.gsd:
                raise ConfigError(f"{dem}: a grid at {grid.gsd:g} m; leave `gsd` away, or give the DEM itself.")
            own = ("crop", "skip_outside", "trust_table", "shard", "block")
            stored = read_config(file) | {k: v for k, v in asdict(config).items() if k in own}
            attributes = {k: file.attrs[k] for k in ("gsd_m", "body_radius_m")}
            source = dem.resolve().parent / str(file.attrs.get("elevation_source", ""))
            yield Terrain(source, grid, stored, attributes, partial(reuse_elevation, dem, file, count > 1), file)
        return
    if images is not None and count > 1:
        raise ConfigError(
            "`shard`: the DEM comes first, then its images. Run 'lunargr ingest DEM' with `shard` and without `images`, and merge; "
            "then give that scene in place of the DEM, with `images` and `shard`."
        )
    with rasters.open_raster(dem, "a DEM", "elevation") as dataset:
        crs = require_crs(str(dem), dataset.crs, dataset.transform, body)
        plan = plan_grid(dem, dataset, config.gsd, body.radius, progress)
        sphere = crs_radius(crs)
        if sphere is not None and abs(sphere - body.radius) > 1 and not plan.holds_radii:
            say(
                f"note: {dem}: its CRS is on a sphere of {sphere:.10g} m, its heights are taken as above {body.radius:.10g} m; "
                f"where they count from its own sphere, name {sphere:.10g} as `body`"
            )
        attributes = {"gsd_m": plan.grid.gsd, "body_radius_m": body.radius}
        if count > 1:
            bands = math.ceil(plan.grid.height / config.block)
            rows = [min(plan.grid.height, config.block * band) for band in shard_range(bands, config.shard)]
            attributes["shard_rows"] = np.array(rows, np.int64)
        stored = asdict(config) | {"resampled": plan.factor is None}
        yield Terrain(dem, plan.grid, stored, attributes, partial(write_elevation, dem, dataset, plan, config))


def _count_bands(dem: Path, config: Config) -> int:
    """Rows of blocks of a raster's grid: more shards than these have nothing to do."""
    with rasters.open_raster(dem, "a DEM", "elevation") as dataset:
        body = find_body(config.body)
        require_crs(str(dem), dataset.crs, dataset.transform, body)
        plan = plan_grid(dem, dataset, config.gsd, body.radius)
    return math.ceil(plan.grid.height / config.block)


def _check_shown(images: Path | None, areas: Sequence[float]) -> None:
    """Refuse images that show no valid ground at all. areas : m2, of each. Raises GeometryError."""
    if not any(areas):
        raise GeometryError(
            f"{images}: expected valid ground under some image, found none: pixels of images and elevations are nodata "
            "wherever both lie; check nodata values and georeferences."
        )


def _write_grid(writer: ArtefactWriter, grid: Grid) -> None:
    writer.write_crs(grid.crs_wkt, grid.transform)
    writer.write("x", grid.xy(0, np.arange(grid.width))[0])
    writer.write("y", grid.xy(np.arange(grid.height), 0)[1])
