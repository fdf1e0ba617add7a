"""Registration of one source image against its rendering from the scene's DEM."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from stages.physics.formation.chain import Observation
from stages.physics.formation.chain import form as form_image
from stages.physics.horizon.scene import SceneTerrain
from stages.physics.images.correlation import SUPPORT_PX
from stages.physics.images.displacement import Field, Relief
from stages.physics.images.fit_displacement import fit_field
from stages.physics.images.registration import BLOCK_PX, Box, Shift, block_shift, prepare
from stages.physics.images.source_images import Source
from stages.physics.images.table import Frame
from stages.physics.maps.grid import Grid
from stages.physics.maps.window import Window
from stages.physics.photometry import get_model

STEP_PX = 64  # from block to block
TILE_PX = 128  # blocks within a square of this size are read and rendered together
MOST_BLOCKS = 256
SECOND_REACH_PX = 4.0
# Only shading matters here: gain and offset are free, and slow changes are filtered out. Limb darkening is free too, between
# these two models: in oblique views another law shades as if the ground lay a fraction of a pixel away.
MODELS = ("lunar_lambert", "lommel_seeliger")


def choose_blocks(row: NDArray, col: NDArray, crop: int, grid: Grid, count: int = MOST_BLOCKS) -> list[Box]:
    """(row, col, height, width) of the blocks of a lattice that crops centred at (row, col) touch, at most ``count``.

    row, col : (n,) px; crop : px. Of more blocks, every so many are kept, the same ones for the same crops.
    """
    height, width = min(BLOCK_PX, grid.height), min(BLOCK_PX, grid.width)
    found: set[tuple[int, int]] = set()
    for r, c in zip(np.asarray(row) - crop // 2, np.asarray(col) - crop // 2, strict=True):
        rows = range(int(r) // STEP_PX, (int(r) + crop - 1) // STEP_PX + 1)
        cols = range(int(c) // STEP_PX, (int(c) + crop - 1) // STEP_PX + 1)
        found.update((a, b) for a in rows for b in cols)
    corners = {
        (min(max(0, a * STEP_PX), grid.height - height), min(max(0, b * STEP_PX), grid.width - width)) for a, b in found
    }
    chosen = sorted(corners)
    if len(chosen) > count:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, count).round().astype(int)]
    return [(r, c, height, width) for r, c in chosen]


@dataclass(frozen=True)
class _Tile:
    """A window of the grid with some blocks and their surroundings, and its renderings, all (h, w).

    box : (row, col, height, width) of the window; blocks : on the grid; renderings : by each of MODELS
    weights : of the pixels in the registration, less in shadow
    """

    box: Box
    blocks: tuple[Box, ...]
    elevation: NDArray[np.float32]
    renderings: tuple[NDArray[np.float32], ...]
    weights: NDArray[np.float32]


def register_frame(
    frame: Frame, source: Source, terrain: SceneTerrain, blocks: Sequence[Box], form: str, max_shift: float
) -> tuple[Field, list[Shift]]:
    """Displacement of ``source`` against its rendering, px of the grid, and the shift of each block.

    form : the most general of displacement.FORMS that may be taken
    A displacement that varies over the ground is fitted twice: shifts that remain are measured in the corrected image, in
    which relief does not distort the blocks and a neighbouring crater is too far away to be taken for the right one.
    """
    tiles = [_prepare_tile(frame, terrain, group, math.ceil(max_shift) + SUPPORT_PX) for group in _groups(blocks)]
    reference = _mean_height(*(t.elevation for t in tiles))
    relief = source.relief(reference) if form != "constant" else None
    middles = np.array([(r + (h - 1) / 2, c + (w - 1) / 2) for r, c, h, w in blocks]).reshape(-1, 2)

    def fit(shifts: list[Shift]) -> Field:
        return fit_field(shifts, middles[:, 0], middles[:, 1], form, None if relief is None else reference)

    shifts = _block_shifts(tiles, blocks, source, relief, None, max_shift)
    field = fit(shifts)
    if field.accepted and field.varies:
        rest = _block_shifts(tiles, blocks, source, relief, field, min(max_shift, SECOND_REACH_PX))
        again = [_add_field(field, r, c, s) for (r, c), s in zip(middles, rest, strict=True)]
        better = fit(again)
        if better.accepted:
            return better, again
    return field, shifts


def _mean_height(*pieces: NDArray[np.float32]) -> float:
    """m, over all known ground; 0 where there is none."""
    known = [piece[np.isfinite(piece)] for piece in pieces]
    return float(np.concatenate(known).mean(dtype=float)) if any(k.size for k in known) else 0.0


def _groups(blocks: Sequence[Box]) -> list[list[Box]]:
    """Neighbouring blocks together, so that their common surroundings are read and rendered once."""
    groups: dict[tuple[int, int], list[Box]] = {}
    for box in blocks:
        groups.setdefault((box[0] // TILE_PX, box[1] // TILE_PX), []).append(box)
    return list(groups.values())


def _prepare_tile(frame: Frame, terrain: SceneTerrain, blocks: list[Box], margin: int) -> _Tile:
    grid = terrain.grid
    r0, c0 = (max(0, min(b[k] for b in blocks) - margin) for k in (0, 1))
    r1 = min(grid.height, max(b[0] + b[2] for b in blocks) + margin)
    c1 = min(grid.width, max(b[1] + b[3] for b in blocks) + margin)
    z = np.asarray(terrain.elevation[r0:r1, c0:c1], np.float32)
    *renderings, lit = render_region(frame, z, terrain, r0, c0)
    # Shadow edges do not depend on the reflectance, so that shadows count; but their inside holds no structure.
    weights = np.where(lit > 0.05, 1.0, 0.5).astype(np.float32)
    return _Tile((r0, c0, r1 - r0, c1 - c0), tuple(blocks), z, tuple(r.astype(np.float32) for r in renderings), weights)


def _block_shifts(
    tiles: list[_Tile],
    blocks: Sequence[Box],
    source: Source,
    relief: Relief | None,
    field: Field | None,
    reach: float,
) -> list[Shift]:
    """The shifts of ``blocks`` in the image as corrected by ``field``."""
    found: dict[Box, Shift] = {}
    for tile in tiles:
        found |= _tile_shifts(tile, source, relief, field, reach)
    return [found[box] for box in blocks]


def _tile_shifts(
    tile: _Tile, source: Source, relief: Relief | None, field: Field | None, reach: float
) -> dict[Box, Shift]:
    row, col, height, width = tile.box
    pixels = source.read(*tile.box, field)
    rendering, *others = (r.astype(float) for r in tile.renderings)
    known = np.isfinite(tile.elevation)
    pattern = None
    if relief is not None:
        r, c = np.meshgrid(
            np.arange(row, row + height, dtype=float), np.arange(col, col + width, dtype=float), indexing="ij"
        )
        pattern = np.stack(relief(r, c, np.where(known, tile.elevation, _mean_height(tile.elevation))))
    patterns = [*others, *albedo_patterns(tile.elevation, rendering)]
    pictures = prepare(pixels.values, rendering, pixels.valid & known, tile.weights, patterns, pattern)
    return {box: block_shift(pictures, (box[0] - row, box[1] - col, *box[2:]), reach) for box in tile.blocks}


def _add_field(field: Field, row: float, col: float, rest: Shift) -> Shift:
    """The whole shift of a block, from the ``rest`` in the image as corrected by ``field``."""
    relief = np.array(rest.relief[0]), np.array(rest.relief[1])
    dx, dy = (float(v) for v in field.at(row, col, relief))
    return replace(rest, dx=rest.dx + dx, dy=rest.dy + dy, share=rest.share + field.share)


def albedo_patterns(z: NDArray[np.float32], rendering: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Patterns that albedo may follow, times ``rendering`` (H, W): height, curvature at three scales, its absolute value
    at two (rims and floors alike), steepness at two and its square.

    z : (H, W) m, NaN taken as level; returns (H, W) each
    """
    filled = np.where(np.isfinite(z), z, np.nanmean(z) if np.isfinite(z).any() else 0.0).astype(float)
    curvature = [cv2.Laplacian(cv2.GaussianBlur(filled, (0, 0), sigma), cv2.CV_64F) for sigma in (0.5, 1.0, 3.0)]
    steepness = [np.hypot(*np.gradient(blurred)) for blurred in (filled, cv2.GaussianBlur(filled, (0, 0), 3.0))]
    patterns = [filled - filled.mean(), *curvature, *map(np.abs, curvature[1:]), *steepness, steepness[0] ** 2]
    light = np.nan_to_num(rendering)
    return [pattern * light for pattern in patterns]


def render_region(
    frame: Frame, z: NDArray[np.float32], terrain: SceneTerrain, row: int, col: int
) -> tuple[NDArray[np.float64], ...]:
    """I/F of a uniform surface by each of MODELS, with shadows, and whether the Sun shines; NaN without terrain.

    z : (h, w) heights of the region, m; row, col : its first pixel on the grid; terrain : casts the shadows
    returns (h, w) for each model, and (h, w) 1 where the Sun shines
    """
    grid, (height, width) = terrain.grid, z.shape
    known = np.isfinite(z)
    mean = float(z[known].mean()) if known.any() else 0.0
    local = grid.local_frames(row + (height - 1) / 2, col + (width - 1) / 2)
    centre = local.up[0] * (grid.radius + mean)
    to_sun = frame.sun_position() - centre
    east, north, up = local.axes[0] @ (to_sun / np.linalg.norm(to_sun))
    to_camera = local.axes[0] @ (frame.camera_position(grid.radius) - centre)
    horizon = terrain.horizon(
        Window(row, col, height, width),
        math.atan2(east, north) % (2 * math.pi),
        math.asin(max(-1.0, min(1.0, float(up)))) - math.radians(5),
    )
    observation = Observation(
        elevation=torch.from_numpy(np.where(known, z, mean).astype(np.float32))[None],
        sun_direction=torch.tensor([[east, north, up]], dtype=torch.float64),
        camera_position=torch.from_numpy(to_camera)[None],
        gsd=grid.gsd,
        body_radius=grid.radius,
        sun_horizon=torch.from_numpy(np.nan_to_num(horizon, nan=-1.5).astype(np.float32))[None],
    )
    images = []
    for model in map(get_model, MODELS):
        coefficients = torch.tensor([p.default for p in model.parameters])[None, :, None, None]
        with torch.no_grad():
            images.append(form_image(observation, model, coefficients)[0].numpy().astype(float))
        images[-1][~known] = np.nan
    lit = (math.asin(max(-1.0, min(1.0, float(up)))) > horizon).astype(float)
    return *images, lit
