"""sample: crop centres per image and a geographic split in which no pixel of ground is shared.

The scene is divided into square ground tiles, each given to one part of the split. This split hangs on the scene, --tile-m,
--split and --seed only, so that whatever is sampled from a scene, by image or as a stack, in crops of any size, learns from
the same ground and is tested on the same. A training crop may lie across tiles of its part; a validation or test crop lies
in one tile, so that tiles share no ground either and their errors are independent.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import CROPS, SCENE, SPLITS, ArtefactWriter, ConfigError, GeometryError, check_output, open_artefact
from schemas.files.outputs import Output
from schemas.provenance import sha256
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.physics.images.table import Frame, load_frames, relative_path, write_frames
from stages.physics.maps.grid import Grid, read_grid
from stages.physics.maps.ground_tiles import PositionMasks, Tiles, bounds_deg, split_tiles, tile_edge
from stages.physics.maps.positions import blocks

LARGEST = 1e9  # m of a tile, crops per km2
MOST_CROPS = 2**31 - 1  # what an index of a pair can count


@dataclass(frozen=True)
class Config:
    """count : crops in all (sites with ``stack``); density : crops per km2 of an image; tile_m : None for automatic."""

    crop: int | None = None
    count: int | None = None
    density: float | None = None
    stack: bool = False
    tile_m: float | None = None
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)
    seed: int = 0
    shard: tuple[int, int] = (0, 1)
    block: int = 1024


@dataclass(frozen=True)
class Part:
    """One part of the split, for the audit."""

    name: str
    pairs: int
    images: int
    tiles: int
    ground_km2: float
    shared_km2: float


def run(
    scene: Path,
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> list[Part]:
    """Write ``crops.h5`` and return the audit of the split. Raises ConfigError or GeometryError."""
    output = Output.of(output)
    if config.count is not None and config.density is not None:
        raise ConfigError("--count and --density: give one of the two.")
    if config.count is not None and not 1 <= config.count <= MOST_CROPS:
        raise ConfigError(f"--count: expected 1 .. {MOST_CROPS} crops, found {config.count}.")
    for option, value in (("--density", config.density), ("--tile-m", config.tile_m)):
        if value is not None and not 0 < value <= LARGEST:
            raise ConfigError(f"{option}: expected a number above 0, up to {LARGEST:g}, found {value:g}.")
    if len(config.split) != 3 or min(config.split) < 0 or not math.isclose(sum(config.split), 1, abs_tol=1e-6):
        raise ConfigError(f"--split: expected three shares that sum to 1, found {config.split}.")
    check_output(output.file, [scene], output.overwrite)
    with open_artefact(scene, SCENE) as file:
        grid = read_grid(file, scene)
        frames = load_frames(file, scene)
        crop = int(file.attrs["crop_px"]) if config.crop is None else config.crop
        if crop % 16 or crop < 16:
            raise ConfigError(f"--crop: expected a multiple of 16 px (the network halves it four times), found {crop}.")
        if crop > min(grid.height, grid.width):
            raise ConfigError(
                f"--crop: expected at most {min(grid.height, grid.width)} px, the edge of {scene}, found {crop}."
            )
        if not frames:
            raise ConfigError(f"{scene}: expected images, found none; run 'lunargr ingest' with --images.")
        positions = PositionMasks(file, grid, crop, config.block)
        edge = tile_edge(grid, positions, config.split, config.tile_m)
        tiles = split_tiles(positions, grid, edge, config.split, config.seed, progress)
        chosen = _choose(positions, tiles, frames, grid, config, np.random.default_rng(config.seed), progress)
        if not len(chosen):
            raise GeometryError(
                f"{scene}: no crop of {crop} px fits into a tile of {edge * grid.gsd:g} m and valid data; choose a smaller --crop or other --tile-m."
            )
        parts = audit(chosen, tiles, grid, crop)
        first, last = (len(chosen) * k // config.shard[1] for k in (config.shard[0], config.shard[0] + 1))
        part = slice(first, last)
        _write(scene, output, file, grid, frames, tiles, chosen, part, crop, config, parts, progress)
    return parts


def read_audit(crops: Path) -> list[Part]:
    """The audit of the split, of all shards, as it stands in the file."""
    with open_artefact(crops, CROPS) as file:
        return [Part(**part) for part in json.loads(file.attrs["split_audit"])]


CHOSEN = np.dtype([("frame", "i4"), ("row", "i4"), ("col", "i4"), ("site", "i4"), ("tile", "i4"), ("split", "u1")])


def _choose(
    positions: PositionMasks,
    tiles: Tiles,
    frames: list[Frame],
    grid: Grid,
    config: Config,
    rng: np.random.Generator,
    progress: Progress,
) -> NDArray:
    """Crop centres, sorted by frame, row, column. Without replacement within an image (within the scene with ``stack``)."""
    layers = [-1] if config.stack else list(range(len(frames)))
    counts = np.zeros((len(layers), 3, len(positions.blocks)), np.int64)
    for number, block in enumerate(positions.blocks):
        progress(number, 2 * len(positions.blocks), "counting positions")
        here = positions.frames_of(block)
        for index, layer in enumerate(layers):
            if layer >= 0 and layer not in here:
                continue
            part = _allowed_parts(positions, tiles, layer, here, block)
            counts[index, :, number] = [(part == k).sum() for k in range(3)]
    wanted = _allocate(counts.sum(2), frames, grid, config)
    picked = []
    take = np.zeros_like(counts)
    for index, k in np.ndindex(len(layers), 3):
        if wanted[index, k]:
            take[index, k] = _spread(rng, counts[index, k], int(wanted[index, k]))
    for number, block in enumerate(positions.blocks):
        progress(len(positions.blocks) + number, 2 * len(positions.blocks), "choosing positions")
        if not take[:, :, number].any():
            continue
        here = positions.frames_of(block)
        for index, layer in enumerate(layers):
            if not take[index, :, number].any():
                continue
            part = _allowed_parts(positions, tiles, layer, here, block)
            for k in range(3):
                flat = rng.choice(np.flatnonzero(part == k), int(take[index, k, number]), replace=False)
                row, col = np.unravel_index(np.sort(flat), part.shape)
                picked.append((layer, k, row + block[0], col + block[1], block, here))
    progress(2 * len(positions.blocks), 2 * len(positions.blocks), "choosing positions")
    return _records(picked, positions, tiles, config.stack)


def _allowed_parts(
    positions: PositionMasks, tiles: Tiles, layer: int, here: list[int], block: tuple[int, int, int, int]
) -> NDArray[np.int8]:
    """Part of the split of every position of a block, -1 where no crop may be centred. Layer -1: any image."""
    row, col, h, w = block
    mask = np.zeros((h, w), bool)
    for frame in here if layer < 0 else [layer]:
        mask |= positions.mask(frame, block)
    part = tiles.allowed(np.arange(row, row + h)[:, None], np.arange(col, col + w), positions.crop)
    return np.where(mask, part, -1)


def _allocate(available: NDArray, frames: list[Frame], grid: Grid, config: Config) -> NDArray[np.int64]:
    """Crops per layer and part: each part its share, within a part in proportion to the layer's valid area."""
    area = available * grid.gsd**2 / 1e6
    if config.density is not None:
        wanted = np.ceil(area * config.density)
    else:
        total = config.count or max(1, min(int(available.sum()), 100 * len(frames)))
        within = area / np.maximum(area.sum(0, keepdims=True), 1e-12)
        exact = within * np.array(config.split) * total
        wanted = np.floor(exact)
        rest = exact - wanted
        for k in range(3):  # hand the rounding's remainder to the largest fractions
            missing = round(float(exact[:, k].sum() - wanted[:, k].sum()))
            wanted[np.argsort(-rest[:, k], kind="stable")[:missing], k] += 1
    return np.minimum(wanted, available).astype(np.int64)


def _spread(rng: np.random.Generator, counts: NDArray[np.int64], wanted: int) -> NDArray[np.int64]:
    """How many of ``wanted`` draws without replacement fall into each block."""
    if counts.sum() < 1_000_000_000:
        return rng.multivariate_hypergeometric(counts, wanted, method="marginals")
    result, left, remaining = np.zeros_like(counts), wanted, int(counts.sum())
    for k, n in enumerate(counts):  # beyond numpy's limit draws hardly deplete a block: binomial, then cap
        result[k] = min(int(n), rng.binomial(left, n / remaining)) if remaining else 0
        left, remaining = left - int(result[k]), remaining - int(n)
    return result


def _records(picked: list, positions: PositionMasks, tiles: Tiles, stack: bool) -> NDArray:
    rows = []
    for layer, k, row, col, block, here in picked:
        covering = here if stack else [layer]
        for frame in covering:
            keep = positions.mask(frame, block)[row - block[0], col - block[1]] if stack else np.ones(len(row), bool)
            part = np.zeros(int(keep.sum()), CHOSEN)
            part["frame"], part["row"], part["col"], part["split"] = frame, row[keep], col[keep], k
            part["tile"] = (part["row"] // tiles.edge) * tiles.part.shape[1] + part["col"] // tiles.edge
            rows.append(part)
    if not rows:
        return np.zeros(0, CHOSEN)
    chosen = np.sort(np.concatenate(rows), order=["frame", "row", "col"])
    _, chosen["site"] = np.unique(chosen["row"].astype(np.int64) << 32 | chosen["col"], return_inverse=True)
    return chosen


def audit(chosen: NDArray, tiles: Tiles, grid: Grid, crop: int) -> list[Part]:
    """Count pairs, images, tiles and ground per part, and the ground that a part shares with another."""
    size = max(2048, 4 * crop)
    half = crop // 2
    ground, shared = np.zeros(3), np.zeros(3)
    for row, col, h, w in blocks(grid.height, grid.width, size):
        near = (
            (chosen["row"] + half > row)
            & (chosen["row"] - half < row + h)
            & (chosen["col"] + half > col)
            & (chosen["col"] - half < col + w)
        )
        if not near.any():
            continue
        painted = np.zeros((h, w), np.uint8)
        for r, c, k in zip(chosen["row"][near], chosen["col"][near], chosen["split"][near], strict=True):
            painted[
                max(0, r - half - row) : max(0, r + half - row), max(0, c - half - col) : max(0, c + half - col)
            ] |= 1 << k
        pixel = float(np.prod(grid.local_frames(row + h / 2, col + w / 2).pixel_size[0])) / 1e6
        for k in range(3):
            mine = (painted & (1 << k)) > 0
            ground[k] += mine.sum() * pixel
            shared[k] += (mine & (painted != (1 << k))).sum() * pixel
    return [
        Part(
            name,
            int((chosen["split"] == k).sum()),
            len(np.unique(chosen["frame"][chosen["split"] == k])),
            int((tiles.part == k).sum()),
            float(ground[k]),
            float(shared[k]),
        )
        for name, k in SPLITS
    ]


def _write(
    scene: Path,
    output: Output,
    file: h5py.File,
    grid: Grid,
    frames: list[Frame],
    tiles: Tiles,
    chosen: NDArray,
    part: slice,
    crop: int,
    config: Config,
    audited: list[Part],
    progress: Progress,
) -> None:
    mine = chosen[part]
    sizes = {"pair": len(mine), "y": crop, "x": crop, "frame": len(frames)}
    digest = sha256(scene)
    attributes = {
        "gsd_m": grid.gsd,
        "body_radius_m": grid.radius,
        "scene": relative_path(scene, output.file.resolve().parent),
        "scene_sha256": digest,
        "tile_m": tiles.edge * grid.gsd,
        "pairs_in_all_shards": np.int64(len(chosen)),
        "split_audit": json.dumps([asdict(p) for p in audited]),
    }
    stored = asdict(config) | {"crop": crop} | tiles.identity(bounds_deg(grid))
    half = crop // 2
    with ArtefactWriter(
        output.file,
        CROPS,
        sizes,
        config=stored,
        inputs=[scene],
        seed=config.seed,
        attributes=attributes,
        overwrite=output.overwrite,
    ) as writer:
        elevation, source = writer.dataset("elevation"), file["elevation"]
        for k, (r, c) in enumerate(zip(mine["row"], mine["col"], strict=True)):
            if k % 100 == 0:
                progress(k, len(mine), "crops")
            elevation[k] = source[r - half : r + half, c - half : c + half]
        progress(len(mine), len(mine), "crops")
        # The centre of an even crop is the corner shared by its four middle pixels.
        lon, lat = grid.lonlat(mine["row"] - 0.5, mine["col"] - 0.5)
        writer.write("longitude_deg", lon)
        writer.write("latitude_deg", lat)
        for name, key in (
            ("row", "row"),
            ("col", "col"),
            ("image_index", "frame"),
            ("site", "site"),
            ("tile", "tile"),
            ("split", "split"),
        ):
            writer.write(name, mine[key])
        write_frames(writer, frames)
