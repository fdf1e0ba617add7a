"""Images that are not where they say: what registration takes off each, found once and shared by all shards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from stages.common.progress import Progress
from stages.physics.images.displacement import Basis, Field
from stages.physics.images.references import References
from stages.physics.images.register_frame import choose_blocks, register_frame
from stages.physics.images.registration import BLOCK_PX

MAX_SHIFT_PX = 8.0  # searched, as in project


def register(references: References, form: str, progress: Progress) -> list[Field | None]:
    """By how much each image lies away from its rendering, from blocks all over it; None where it shows nothing."""
    found: list[Field | None] = []
    grid = references.surface.grid
    for k, (frame, footprint) in enumerate(zip(references.frames, references.footprints, strict=True)):
        progress(k, len(references.frames), "registration")
        row, col, height, width = footprint.box
        if not (height and width):
            found.append(None)
            continue
        rows, cols = np.meshgrid(
            np.arange(row, row + height, BLOCK_PX), np.arange(col, col + width, BLOCK_PX), indexing="ij"
        )
        middle = BLOCK_PX // 2
        blocks = choose_blocks(rows.ravel() + middle, cols.ravel() + middle, BLOCK_PX, grid)
        source = references.source(k)
        field, _ = register_frame(frame, source, references.terrain, blocks, form, MAX_SHIFT_PX)
        found.append(field)
    return found


def as_text(fields: Sequence[Field | None]) -> list[Any]:
    """What JSON holds of them."""
    return [None if f is None else asdict(f) | {"coefficients": f.coefficients.tolist()} for f in fields]


def from_text(text: Sequence[Any]) -> list[Field | None]:
    """The inverse of :func:`as_text`."""
    found: list[Field | None] = []
    for values in text:
        if values is None:
            found.append(None)
            continue
        basis = values["basis"]
        shape = Basis(basis["form"], tuple(basis["origin"]), basis["step"], tuple(basis["cells"]))
        numbers = {"coefficients": np.array(values["coefficients"], float), "mean": tuple(values["mean"])}
        found.append(Field(**values | {"basis": shape} | numbers))
    return found
