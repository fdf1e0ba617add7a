"""Masks of the ground that each image shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import h5py
import numpy as np

from schemas import ArtefactWriter, GeometryError, InputError
from schemas.provenance import sha256
from stages.common.progress import Progress, Say, say_nothing
from stages.ingest.config import Config
from stages.ingest.plan import ANY_RELIEF
from stages.physics.images.angles import angle_bands
from stages.physics.images.source_images import open_source
from stages.physics.images.table import Frame
from stages.physics.images.table_checks import check_emission
from stages.physics.maps.grid import Grid
from stages.physics.maps.positions import blocks


def check_frames(
    frames: Sequence[Frame], grid: Grid, skip_outside: bool, say: Say = say_nothing
) -> tuple[list[Frame], list[str]]:
    """The images that touch the DEM, and the names of the others, which without ``skip_outside`` raise InputError.

    say : told what cameras took otherwise than their files say
    """
    kept, skipped = [], []
    for frame in frames:
        # The DEM is not read yet: the ground that a camera image can show is sought within any body's relief.
        relief = ANY_RELIEF * grid.radius
        with open_source(frame, grid, None, (-relief, relief)) as source:
            for note in source.notes:
                say(f"note: {note}")
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
    """Write the mask of the image with this index; returns the valid ground that it shows, m2."""
    valid, area = writer.dataset("valid"), 0.0
    dem_valid = dem["dem_valid"]
    with open_source(frame, grid, dem["elevation"], heights) as source:
        row0, col0, height, width = source.box() or (0, 0, 0, 0)
        rows, cols = np.zeros(height, bool), np.zeros(width, bool)  # whether they hold any valid pixel
        todo = list(blocks(height, width, config.block))
        for number, (r, c, h, w) in enumerate(todo):
            progress(number, len(todo), f"image masks ({frame.image_id})")
            part = np.s_[row0 + r : row0 + r + h, col0 + c : col0 + c + w]
            seen = source.read(row0 + r, col0 + c, h, w).valid & dem_valid[part].astype(bool)
            if seen.any():
                valid[(index, *part)] = seen
                rows[r : r + h] |= seen.any(axis=1)
                cols[c : c + w] |= seen.any(axis=0)
                middle = row0 + r + h / 2, col0 + c + w / 2
                area += float(seen.sum()) * float(np.prod(grid.local_frames(*middle).pixel_size[0]))
    if not rows.any():
        writer.dataset("frame_window")[index] = (row0, col0, 0, 0)
        return 0.0
    r0, r1 = row0 + int(rows.argmax()), row0 + height - int(rows[::-1].argmax())
    c0, c1 = col0 + int(cols.argmax()), col0 + width - int(cols[::-1].argmax())
    writer.dataset("frame_window")[index] = (r0, c0, r1 - r0, c1 - c0)
    _check_sun(frame, grid, (r0 + r1) / 2, (c0 + c1) / 2)
    if frame.angles is not None:
        angle_bands(frame.angles)
    if not config.trust_table:
        check_emission(frame, grid, (r0 + r1) / 2, (c0 + c1) / 2)
    return area


def hash_files(frame: Frame) -> Frame:
    """The frame with the SHA-256 of the files that its masks were made from. Raises InputError."""
    try:
        return replace(frame, sha256=sha256(frame.path), camera_sha256=sha256(frame.camera) if frame.camera else "")
    except OSError as error:
        raise InputError(
            f"{error.filename}: image '{frame.image_id}' cannot be read any more ({error.strerror}); bring it back."
        ) from None


def _check_sun(frame: Frame, grid: Grid, row: float, col: float) -> None:
    local = grid.local_frames(row, col)
    sun = frame.sun_position() - grid.radius * local.up[0]
    sine = float(local.up[0] @ sun / np.linalg.norm(sun))
    if sine <= 0:
        raise GeometryError(
            f"image '{frame.image_id}': the Sun stands {-math.degrees(math.asin(sine)):.1f} deg below the horizon at the image's centre; "
            "check its sub-solar longitude and latitude (degrees east)."
        )
