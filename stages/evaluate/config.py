"""What evaluate is asked for."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output, Target

if TYPE_CHECKING:
    from stages.common.runner import Call

FIGURES = ("training_curves.png", "errors.png", "crop_best.png", "crop_median.png", "crop_worst.png")


@dataclass(frozen=True)
class Config:
    """fit_pairs : bounds the pairs that baselines are fitted on (0: all); renderings : whether every rendered crop is kept,
    None: where they are small; only : rows of the table, () for all; extend : the diagnosis whose extended model is scored, too;
    published : the set of Hapke's parameters that is scored, None: the one nearest to the images' wavelength
    """

    split: str = "test"
    batch: int = 16
    fit_pairs: int = 4096
    renderings: bool | None = None
    seed: int = 0
    device: str = "auto"
    only: tuple[str, ...] = ()
    extend: str | None = None
    published: str | None = None


@dataclass(frozen=True)
class HeldOutConfig:
    """split : whose pairs are scored"""

    split: str = "test"
    seed: int = 0


def input_files(call: Call) -> list[Path]:
    """What no output may replace."""
    return [*call.files, *([Path(call.config.extend)] if call.config.extend else [])]


def report_files(output: Output) -> list[Path]:
    """The JSON beside the output, and where it was asked for."""
    beside, wanted = output.file.with_suffix(".json"), output.json
    return [beside] if wanted is None or os.path.realpath(wanted) == os.path.realpath(beside) else [beside, wanted]


def targets(call: Call) -> Iterator[Target]:
    """The artefact, its JSON and its figures."""
    path, (beside, *others) = call.output.file, report_files(call.output)
    yield Target(path)
    yield Target(beside, name=f"the JSON beside {path.name}")
    yield from (Target(report, "json") for report in others)
    if (folder := call.output.figures) is not None:
        yield from (Target(folder / name, "figures") for name in FIGURES)
