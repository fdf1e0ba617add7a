"""sample: crops and a geographic split. stage: from files to files; places: crop centres; audit: of the split."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.sample.config import Config

if TYPE_CHECKING:
    from stages.sample.audit import Part

__all__ = ["Config", "run"]


@runner.stage(in_parts=True)
def run(
    scene: Path, output: Output | Path, config: Config, say: Say = say_nothing, progress: Progress = show_nothing
) -> list[Part]:
    """Write ``crops.h5`` and return the audit of the split. Raises ConfigError or GeometryError."""
    from stages.sample.stage import work

    return work(scene, Output.at(output), config, progress)
