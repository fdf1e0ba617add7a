"""view: one self-contained page that relights a learned map in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, show_nothing
from stages.view.config import Config

if TYPE_CHECKING:
    from stages.view.stage import Summary

__all__ = ["Config", "run"]


@runner.stage()
def run(
    source: Path, pairs: Path | None, output: Output | Path, config: Config, progress: Progress = show_nothing
) -> Summary:
    """Write the page of ``source`` (svbrdf.h5), with photographs of ``pairs`` where given. Raises LunargrError."""
    from stages.view.stage import work

    return work(source, pairs, Output.at(output), config, progress)
