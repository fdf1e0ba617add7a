"""sample: crop centres per image and a geographic split in which no pixel of ground is shared.

The scene is divided into square ground tiles, each given to one part of the split. The split depends on the scene,
`tile_m`, `split` and `seed` only: whatever is sampled from a scene, by image or as a stack, in crops of any size,
trains on the same ground and is tested on the same. A training crop may lie across tiles of its part; a validation or
test crop lies in one tile, so that tiles share no ground either and their errors are independent.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import CROPS, SCENE, ArtefactWriter, ConfigError, GeometryError, open_artefact
from schemas.files.outputs import Output
from schemas.provenance import sha256
from stages import merge
from stages.common.progress import Progress
from stages.common.runner.job import Job
from stages.common.shards import shard_range
from stages.physics.images.table import Frame, load_frames, relative_path, write_frames
from stages.physics.maps.grid import Grid, read_grid
from stages.physics.maps.ground_tiles import PositionMasks, Tiles, bounds_deg, split_tiles, tile_edge
from stages.sample.audit import Part, audit, read_audit
from stages.sample.config import Config
from stages.sample.places import choose_places

SHARDS = 4
LARGEST = 1e9  # m of a tile, crops per km2
MOST_CROPS = 2**31 - 1  # an index of a pair is an int32


@dataclass(frozen=True)
class Scene:
    """An open scene, and the edge of the crops, px."""

    path: Path
    grid: Grid
    frames: list[Frame]
    crop: int


def work(scene: Path, output: Output, config: Config, progress: Progress) -> list[Part]:
    """See :func:`stages.sample.run`."""
    _check(config)
    with open_artefact(scene, SCENE) as file:
        opened = _read(scene, file, config)
        grid, crop = opened.grid, opened.crop
        positions = PositionMasks(file, grid, crop, config.block)
        edge = tile_edge(grid, positions, config.split, config.tile_m)
        tiles = split_tiles(positions, grid, edge, config.split, config.seed, progress)
        rng = np.random.default_rng(config.seed)
        chosen = choose_places(positions, tiles, len(opened.frames), grid, config, rng, progress)
        if not len(chosen):
            raise _no_crop_fits(scene, positions, edge)
        parts = audit(chosen, tiles, grid, crop)
        _write(opened, output, chosen, tiles, parts, config)
    return parts


def in_parts(job: Job, scene: Path, config: Config) -> list[Part]:
    """The crops from shards: each chooses all places, which is quick, and cuts out its share of the crops."""
    pieces = job.shards("crops", [scene], config, job.output.parts or SHARDS)
    merge.run(pieces, Output(job.output.file, overwrite=True), merge.Config(inputs=(scene,)), progress=job.progress)
    return read_audit(job.output.file)


def _check(config: Config) -> None:
    if config.count is not None and config.density is not None:
        raise ConfigError("`count` and `density`: give one of the two.")
    if config.count is not None and not 1 <= config.count <= MOST_CROPS:
        raise ConfigError(f"`count`: expected 1 .. {MOST_CROPS} crops, found {config.count}.")
    for option, value in (("`density`", config.density), ("`tile_m`", config.tile_m)):
        if value is not None and not 0 < value <= LARGEST:
            raise ConfigError(f"{option}: expected a number above 0, up to {LARGEST:g}, found {value:g}.")
    if len(config.split) != 3 or min(config.split) < 0 or not math.isclose(sum(config.split), 1, abs_tol=1e-6):
        raise ConfigError(f"`split`: expected three shares that sum to 1, found {config.split}.")


def _read(path: Path, file: h5py.File, config: Config) -> Scene:
    """Raises ConfigError for a scene without images, or too small for a crop."""
    grid, frames = read_grid(file, path), load_frames(file, path)
    crop = int(file.attrs["crop_px"]) if config.crop is None else config.crop
    if crop % 16 or crop < 16:
        raise ConfigError(f"`crop`: expected a multiple of 16 px (the network halves it four times), found {crop}.")
    if crop > min(grid.height, grid.width):
        raise ConfigError(
            f"`crop`: expected at most {min(grid.height, grid.width)} px, the edge of {path}, found {crop}."
        )
    if not frames:
        raise ConfigError(f"{path}: expected images, found none; run 'lunargr ingest' with `images`.")
    return Scene(path, grid, frames, crop)


def _no_crop_fits(scene: Path, positions: PositionMasks, edge: int) -> GeometryError:
    """What to do where no crop lies on valid ground, or none in a tile of ``edge`` px."""
    crop, gsd, side = positions.crop, positions.grid.gsd, positions.largest_square()
    if side >= crop:
        return GeometryError(
            f"{scene}: no crop of {crop} px fits into a tile of {edge * gsd:g} m and valid data; choose a smaller `crop` or other `tile_m`."
        )
    smaller = f"choose a `crop` of at most {side // 16 * 16} px, or " if side >= 16 else ""
    return GeometryError(
        f"{scene}: a crop of {crop} px ({crop * gsd:g} m) is larger than any valid region of any image, where {side * gsd:g} m "
        f"({side} px) fit; {smaller}take a grid of {max(side, 1) * gsd / crop:.3g} m or finer (`gsd` of 'lunargr ingest'), from a DEM "
        "that is as fine."
    )


def _write(
    scene: Scene,
    output: Output,
    chosen: NDArray,
    tiles: Tiles,
    audited: list[Part],
    config: Config,
) -> None:
    """The crops of this shard. chosen : the centres of all shards"""
    grid, crop = scene.grid, scene.crop
    mine = chosen[slice(*shard_range(len(chosen), config.shard))]
    attributes = {
        "gsd_m": grid.gsd,
        "body_radius_m": grid.radius,
        "crop_px": np.int32(crop),
        "scene": relative_path(scene.path, output.file.resolve().parent),
        "scene_sha256": sha256(scene.path),
        "tile_m": tiles.edge * grid.gsd,
        "pairs_in_all_shards": np.int64(len(chosen)),
        "split_audit": json.dumps([asdict(p) for p in audited]),
    }
    with ArtefactWriter(
        output.file,
        CROPS,
        {"pair": len(mine), "frame": len(scene.frames)},
        config=asdict(config) | {"crop": crop} | tiles.identity(bounds_deg(grid)),
        inputs=[scene.path],
        seed=config.seed,
        attributes=attributes,
    ) as writer:
        # The centre of an even crop is the corner shared by its four middle pixels.
        lon, lat = grid.lonlat(mine["row"] - 0.5, mine["col"] - 0.5)
        writer.write("longitude_deg", lon)
        writer.write("latitude_deg", lat)
        writer.write("row", mine["row"])
        writer.write("col", mine["col"])
        writer.write("image_index", mine["frame"])
        for name in ("site", "tile", "split"):
            writer.write(name, mine[name])
        write_frames(writer, scene.frames)
