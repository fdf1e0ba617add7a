"""Registration of one source image against its rendering from the scene's DEM."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from stages.physics.formation.chain import Observation, form
from stages.physics.horizon.scene import Overview, horizon_in_scene
from stages.physics.images.registration import Field, Shift, estimate_shift, fit_field
from stages.physics.images.source_images import Source
from stages.physics.images.table import Frame
from stages.physics.maps.grid import Grid
from stages.physics.photometry import get_model

REGION_PX = 128  # a side; smaller crops say too little each
MOST_REGIONS = 64
# Shading alone matters here: gain and offset are free, and slow changes are taken off. How the surface darkens towards the
# limb is free too, between these two: over oblique views another law shades as if the ground lay a part of a pixel away.
MODELS = ("lunar_lambert", "lommel_seeliger")


def choose_regions(
    row: NDArray, col: NDArray, grid: Grid, count: int = MOST_REGIONS
) -> list[tuple[int, int, int, int]]:
    """(row, col, height, width) of at most ``count`` regions about crop centres, spread over them; always the same ones."""
    height, width = min(REGION_PX, grid.height), min(REGION_PX, grid.width)
    corners = np.stack(
        [
            np.clip(row - height // 2, 0, grid.height - height),
            np.clip(col - width // 2, 0, grid.width - width),
        ],
        axis=1,
    )
    corners = np.unique(corners, axis=0)
    if not len(corners):
        return []
    chosen = [0]
    distance = np.full(len(corners), np.inf)
    while len(chosen) < min(count, len(corners)):
        distance = np.minimum(distance, np.abs(corners - corners[chosen[-1]]).max(axis=1))
        farthest = int(distance.argmax())
        if distance[farthest] < REGION_PX / 4:  # the rest lies in what is already there
            break
        chosen.append(farthest)
    return [(int(r), int(c), height, width) for r, c in corners[sorted(chosen)]]


def register_frame(
    frame: Frame,
    source: Source,
    elevation: Any,
    overview: Overview,
    grid: Grid,
    regions: Sequence[tuple[int, int, int, int]],
    kind: str,
    max_shift: float,
) -> tuple[Field, list[Shift]]:
    """How far ``source`` lies from its rendering, px of the grid, and what each region said.

    elevation : (H, W) array or dataset; kind : 'shift' or 'affine'
    """
    shifts = []
    for row, col, height, width in regions:
        z = np.asarray(elevation[row : row + height, col : col + width], np.float32)
        pixels = source.read(row, col, height, width)
        rendering, *others, lit = render_region(frame, z, elevation, overview, grid, row, col)
        valid = pixels.valid & np.isfinite(z)
        # Shadows lie where they do whatever the surface is like: they count, but their inside holds no structure.
        weights = np.where(lit > 0.05, 1.0, 0.5)
        patterns = [*others, *albedo_patterns(z, rendering)]
        shifts.append(estimate_shift(pixels.values, rendering, valid, weights, max_shift, patterns))
    middles = np.array([(r + (h - 1) / 2, c + (w - 1) / 2) for r, c, h, w in regions]).reshape(-1, 2)
    return fit_field(shifts, middles[:, 0], middles[:, 1], kind), shifts


def albedo_patterns(z: NDArray[np.float32], rendering: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """What albedo may follow, as it shows under the light of ``rendering``: height, curvature at three scales and its
    size at two (rims and floors alike), steepness at two and its square; (H, W) each, NaN taken as level."""
    filled = np.where(np.isfinite(z), z, np.nanmean(z) if np.isfinite(z).any() else 0.0).astype(float)
    curvature = [cv2.Laplacian(cv2.GaussianBlur(filled, (0, 0), sigma), cv2.CV_64F) for sigma in (0.5, 1.0, 3.0)]
    steepness = [np.hypot(*np.gradient(blurred)) for blurred in (filled, cv2.GaussianBlur(filled, (0, 0), 3.0))]
    patterns = [filled - filled.mean(), *curvature, *map(np.abs, curvature[1:]), *steepness, steepness[0] ** 2]
    light = np.nan_to_num(rendering)
    return [pattern * light for pattern in patterns]


def render_region(
    frame: Frame, z: NDArray[np.float32], elevation: Any, overview: Overview, grid: Grid, row: int, col: int
) -> tuple[NDArray[np.float64], ...]:
    """I/F of a uniform surface by each of MODELS, shadows cast by the whole scene, and whether the Sun shines; NaN without
    terrain."""
    height, width = z.shape
    known = np.isfinite(z)
    mean = float(z[known].mean()) if known.any() else 0.0
    local = grid.local_frames(row + (height - 1) / 2, col + (width - 1) / 2)
    centre = local.up[0] * (grid.radius + mean)
    to_sun = frame.sun_position() - centre
    east, north, up = local.axes[0] @ (to_sun / np.linalg.norm(to_sun))
    to_camera = local.axes[0] @ (frame.camera_position(grid.radius) - centre)
    horizon = horizon_in_scene(
        elevation,
        overview,
        row,
        col,
        height,
        width,
        grid.gsd,
        math.atan2(east, north) % (2 * math.pi),
        sun_elevation=math.asin(max(-1.0, min(1.0, float(up)))) - math.radians(5),
        body_radius=grid.radius,
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
            images.append(form(observation, model, coefficients)[0].numpy().astype(float))
        images[-1][~known] = np.nan
    lit = (math.asin(max(-1.0, min(1.0, float(up)))) > horizon).astype(float)
    return *images, lit
