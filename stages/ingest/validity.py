"""Which images see which ground, and where their crops may be centred."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import h5py
import numpy as np

from schemas import (
    ArtefactWriter,
    GeometryError,
    InputError,
)
from schemas.provenance import sha256
from stages.common.progress import Progress
from stages.ingest.config import Config
from stages.ingest.plan import ANY_RELIEF
from stages.physics.images.source_images import open_source
from stages.physics.images.table import Frame
from stages.physics.maps.grid import Grid
from stages.physics.maps.positions import blocks, valid_positions


def check_frames(frames: Sequence[Frame], grid: Grid, skip_outside: bool) -> tuple[list[Frame], list[str]]:
    """Every image must be readable, lie on the DEM and be lit. Raises InputError or GeometryError."""
    kept, skipped = [], []
    for frame in frames:
        # The DEM is not read yet: camera images are looked for at the heights that relief can have on any body.
        relief = ANY_RELIEF * grid.radius
        with open_source(frame, grid, None, (-relief, relief)) as source:
            if source.box() is None:
                if not skip_outside:
                    raise InputError(
                        f"{frame.path}: image '{frame.image_id}' does not touch the DEM; remove it from the table or add `skip_outside`."
                    )
                skipped.append(frame.image_id)
                continue
        kept.append(frame)
    return kept, skipped


def write_validity(
    frame: Frame,
    index: int,
    grid: Grid,
    heights: tuple[float, float],
    dem: h5py.File,
    writer: ArtefactWriter,
    config: Config,
    progress: Progress,
) -> float:
    """Write the masks of the image with this index; returns the ground area of its valid positions, m2."""
    valid, position = writer.dataset("valid"), writer.dataset("valid_position")
    dem_valid = dem["dem_valid"]
    used: tuple[int, int, int, int] | None = None
    with open_source(frame, grid, dem["elevation"], heights) as source:
        row0, col0, height, width = source.box() or (0, 0, 0, 0)
        todo = list(blocks(height, width, config.block))
        for number, (r, c, h, w) in enumerate(todo):
            progress(number, len(todo), f"image masks ({frame.image_id})")
            r, c = row0 + r, col0 + c
            seen = source.read(r, c, h, w).valid & dem_valid[r : r + h, c : c + w].astype(bool)
            if seen.any():
                valid[index, r : r + h, c : c + w] = seen
                rows, cols = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
                used = _union(used, (r + rows[0], c + cols[0], r + rows[-1] + 1, c + cols[-1] + 1))
    if used is None:
        writer.dataset("frame_window")[index] = (row0, col0, 0, 0)
        return 0.0
    r0, c0, r1, c1 = used
    writer.dataset("frame_window")[index] = (r0, c0, r1 - r0, c1 - c0)
    area = 0.0
    for r, c, h, w in blocks(r1 - r0, c1 - c0, config.block):
        r, c = r0 + r, c0 + c
        eroded = valid_positions(valid[index], grid.height, grid.width, (r, c, h, w), config.crop)
        if eroded.any():
            position[index, r : r + h, c : c + w] = eroded
            pixel = grid.local_frames(r + h / 2, c + w / 2).pixel_size[0]
            area += float(eroded.sum()) * float(pixel[0] * pixel[1])
    _check_sun(frame, grid, (r0 + r1) / 2, (c0 + c1) / 2)
    return area


def with_digests(frame: Frame) -> Frame:
    """What the files held that the masks were made from. Raises InputError."""
    try:
        return replace(frame, sha256=sha256(frame.path), camera_sha256=sha256(frame.camera) if frame.camera else "")
    except OSError as error:
        raise InputError(
            f"{error.filename}: image '{frame.image_id}' cannot be read any more ({error.strerror}); bring it back."
        ) from None


def _union(box: tuple[int, int, int, int] | None, other: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    if box is None:
        return other
    return min(box[0], other[0]), min(box[1], other[1]), max(box[2], other[2]), max(box[3], other[3])


def _check_sun(frame: Frame, grid: Grid, row: float, col: float) -> None:
    local = grid.local_frames(row, col)
    sun = frame.sun_position() - grid.radius * local.up[0]
    sine = float(local.up[0] @ sun / np.linalg.norm(sun))
    if sine <= 0:
        raise GeometryError(
            f"image '{frame.image_id}': the Sun stands {-math.degrees(math.asin(sine)):.1f} deg below the horizon at the image's centre; "
            "check its sub-solar longitude and latitude (degrees east)."
        )
