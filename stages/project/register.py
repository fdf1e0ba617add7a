"""Registration of the images of pairs, their likeness to renderings, and what pairs.h5 records of both."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import h5py
import numpy as np

from schemas import ArtefactWriter
from stages.physics.images.displacement import Field
from stages.physics.images.source_images import Source
from stages.physics.images.table import Frame
from stages.project.config import Config
from stages.project.inputs import Scene
from stages.project.summary import RESEMBLANCE, Registered, Resemblance


def register(frame: Frame, index: int, source: Source, crops: h5py.File, scene: Scene, config: Config) -> Registered:
    """Register one image by blocks about all of its crops, also those of other shards: all shards find the same."""
    # imported here: it renders with torch, whose import would take most of the time of a small run
    from stages.physics.images.register_frame import choose_blocks, register_frame

    began = time.monotonic()
    mine = crops["image_index"][...] == index
    size = int(crops.attrs["crop_px"])
    blocks = choose_blocks(crops["row"][...][mine], crops["col"][...][mine], size, scene.grid)
    field, shifts = register_frame(frame, source, scene, blocks, str(config.register), config.max_shift)
    places = [(r + (h - 1) / 2, c + (w - 1) / 2) for r, c, h, w in blocks]
    answers = tuple((r, c, s) for (r, c), s in zip(places, shifts, strict=True))
    return Registered(frame.image_id, field, answers, time.monotonic() - began)


def displacement_at(source: Source, field: Field, row: float, col: float, height: float) -> tuple[float, float]:
    """(dx, dy) px that ``field`` takes off at one place of the grid, ``height`` m above the sphere."""
    relief = source.relief(field.reference) if field.share else None
    place = np.array([row]), np.array([col])
    dx, dy = field.at(*place, None if relief is None else relief(*place, np.array([height])))
    return float(dx[0]), float(dy[0])


def combined_share(registered: Sequence[Registered]) -> tuple[float, float, int]:
    """Share of the relief displacement over all images that have some, its standard error, and how many these are.

    Weighted by the images' own errors; where they differ by more than these, the error grows with that (Birge 1932,
    Phys. Rev. 40:207).
    """
    found = [(r.field.share, r.field.share_error) for r in registered if r.field.accepted and r.field.share]
    found = [(share, error) for share, error in found if error > 0]
    if not found:
        return math.nan, math.nan, 0
    share, error = np.array(found).T
    weight = 1 / error**2
    mean = float((weight * share).sum() / weight.sum())
    excess = float((weight * (share - mean) ** 2).sum()) / max(1, len(share) - 1)
    return mean, math.sqrt(max(1.0, excess) / float(weight.sum())), len(share)


def resemble(
    frame: Frame, index: int, source: Source, crops: h5py.File, scene: Scene, field: Field | None
) -> Resemblance:
    """Compare one image with its rendering at some blocks about all of its crops: all shards find the same."""
    from stages.physics.images.register_frame import choose_blocks
    from stages.project.resemblance import BLOCKS, compare_with_rendering

    mine = crops["image_index"][...] == index
    rows, cols = (crops[name][...][mine] for name in ("row", "col"))
    blocks = choose_blocks(rows, cols, int(crops.attrs["crop_px"]), scene.grid, BLOCKS)
    return compare_with_rendering(frame, source, scene, blocks, field)


def write_resemblances(writer: ArtefactWriter, frames: Sequence[Frame], found: Sequence[Resemblance]) -> None:
    """One value per image and variable, NaN for images without crops here."""
    known = {entry.image_id: entry for entry in found}
    for name, attribute in zip(RESEMBLANCE, ("correlation", "chance", "contrast", "mean"), strict=True):
        column = [getattr(known[f.image_id], attribute) if f.image_id in known else math.nan for f in frames]
        writer.write(name, np.array(column, float))


FRAME_VARIABLES: dict[str, Callable[[Field], float]] = {
    "shift_col_px": lambda field: field.mean[0],
    "shift_row_px": lambda field: field.mean[1],
    "shift_sigma_px": lambda field: field.sigma,
    "shift_correlation": lambda field: field.correlation,
    "shift_scatter_px": lambda field: field.scatter,
    "shift_freedom": lambda field: field.freedom,
    "shift_held_out": lambda field: field.held_out,
    "relief_share": lambda field: field.share,
    "relief_share_error": lambda field: field.share_error,
}


def write_registration(writer: ArtefactWriter, frames: Sequence[Frame], registered: Sequence[Registered]) -> None:
    """One value per image and variable of what was taken off, NaN for images that stay where they were."""
    fields = {entry.image_id: entry.field for entry in registered if entry.field.accepted}
    for name, value in FRAME_VARIABLES.items():
        column = [value(fields[f.image_id]) if f.image_id in fields else math.nan for f in frames]
        writer.write(name, np.array(column, float))
