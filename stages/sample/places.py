"""The choice of crop centres: drawn at random within each image, for each part of the split by its share.

With ``stack`` places are drawn in the scene, for all images, and apart while there is room: crops on the same ground
would measure it twice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.common.progress import Progress
from stages.physics.maps.grid import Grid
from stages.physics.maps.ground_tiles import PositionMasks, Tiles
from stages.sample.config import Config

CANDIDATES = 50  # drawn for each place of a stack
MOST_CANDIDATES = 200_000

CHOSEN = np.dtype([("frame", "i4"), ("row", "i4"), ("col", "i4"), ("site", "i4"), ("tile", "i4"), ("split", "u1")])


def choose_places(
    positions: PositionMasks,
    tiles: Tiles,
    frames: int,
    grid: Grid,
    config: Config,
    rng: np.random.Generator,
    progress: Progress,
) -> NDArray:
    """Crop centres, sorted by frame, row, column. Without replacement within an image (within the scene with ``stack``)."""
    layers = [-1] if config.stack else list(range(frames))
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
            take[index, k] = _draw_counts(
                rng, counts[index, k], _count_candidates(int(wanted[index, k]), int(counts[index, k].sum()), config)
            )
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
    if config.stack:
        picked = _keep_apart(picked, wanted[0], positions.crop, rng)
    return _records(picked, positions, tiles, config.stack)


def _allowed_parts(
    positions: PositionMasks, tiles: Tiles, layer: int, here: list[int], block: tuple[int, int, int, int]
) -> NDArray[np.int8]:
    """Part of the split of every position of a block, -1 where no crop may be centred. layer : an image, -1 for any"""
    row, col, h, w = block
    mask = np.zeros((h, w), bool)
    for frame in here if layer < 0 else [layer]:
        mask |= positions.mask(frame, block)
    part = tiles.allowed(np.arange(row, row + h)[:, None], np.arange(col, col + w), positions.crop)
    return np.where(mask, part, -1)


def _allocate(available: NDArray, frames: int, grid: Grid, config: Config) -> NDArray[np.int64]:
    """Crops per layer and part of the split: each part gets its share, and in it each layer by its valid area."""
    area = available * grid.gsd**2 / 1e6
    if config.density is not None:
        wanted = np.ceil(area * config.density)
    else:
        total = config.count or max(1, min(int(available.sum()), 100 * frames))
        within = area / np.maximum(area.sum(0, keepdims=True), 1e-12)
        exact = within * np.array(config.split) * total
        wanted = np.floor(exact)
        rest = exact - wanted
        for k in range(3):  # hand the rounding's remainder to the largest fractions
            missing = round(float(exact[:, k].sum() - wanted[:, k].sum()))
            wanted[np.argsort(-rest[:, k], kind="stable")[:missing], k] += 1
    return np.minimum(wanted, available).astype(np.int64)


def _draw_counts(rng: np.random.Generator, counts: NDArray[np.int64], wanted: int) -> NDArray[np.int64]:
    """How many of ``wanted`` draws without replacement fall into each block. counts : (blocks,) positions in each"""
    if counts.sum() < 1_000_000_000:
        return rng.multivariate_hypergeometric(counts, wanted, method="marginals")
    result, left, remaining = np.zeros_like(counts), wanted, int(counts.sum())
    for k, n in enumerate(counts):  # beyond numpy's limit draws hardly deplete a block: binomial, then cap
        result[k] = min(int(n), rng.binomial(left, n / remaining)) if remaining else 0
        left, remaining = left - int(result[k]), remaining - int(n)
    return result


def _count_candidates(wanted: int, available: int, config: Config) -> int:
    """How many positions to draw for that many places: more for a stack, whose places are kept apart."""
    return min(available, max(wanted, min(CANDIDATES * wanted, MOST_CANDIDATES))) if config.stack else wanted


def _keep_apart(picked: list, wanted: NDArray[np.int64], crop: int, rng: np.random.Generator) -> list:
    """As many of the candidates as are wanted of each part of the split, those first whose crops share no ground."""
    kept = []
    for k in range(3):
        mine = [p for p in picked if p[1] == k]
        if not mine:
            continue
        row, col = (np.concatenate([p[j] for p in mine]) for j in (2, 3))
        chosen = _pick_apart(row, col, int(wanted[k]), crop, rng)
        ends = np.cumsum([len(p[2]) for p in mine])[:-1]
        for part, here in zip(mine, np.split(chosen, ends), strict=True):
            kept.append((*part[:2], part[2][here], part[3][here], *part[4:]))
    return kept


def _pick_apart(row: NDArray, col: NDArray, wanted: int, crop: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which places to take, (n,): in random order, at least a crop apart, then at least half of that, and so on."""
    order, distance = rng.permutation(len(row)), crop
    taken: list[int] = []
    chosen = np.zeros(len(row), bool)
    while distance and len(taken) < wanted:
        cells: dict[tuple[int, int], list[int]] = {}
        for place in taken:
            cells.setdefault((int(row[place]) // distance, int(col[place]) // distance), []).append(place)
        for place in order[~chosen[order]]:
            r, c = int(row[place]), int(col[place])
            at = r // distance, c // distance
            near = [q for i in (-1, 0, 1) for j in (-1, 0, 1) for q in cells.get((at[0] + i, at[1] + j), ())]
            if len(taken) < wanted and not any(abs(r - row[q]) < distance and abs(c - col[q]) < distance for q in near):
                cells.setdefault(at, []).append(place)
                taken.append(place)
                chosen[place] = True
        distance //= 2
    return chosen


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
