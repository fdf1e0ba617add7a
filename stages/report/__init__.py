"""`lunargr report`: everything a run has produced, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, show_nothing
from stages.report.config import Config

__all__ = ["Config", "run"]


@runner.stage()
def run(files: Sequence[Path], output: Output | Path, config: Config, progress: Progress = show_nothing) -> list[str]:
    """Write the page and return the titles of its sections.

    files : artefacts, JSON results of evaluate, match, compare and diagnose, PNG or JPEG pictures, and pages of
    `lunargr view` to link to, in any order; `view.html` beside the output is linked, too
    Raises ConfigError, ArtefactError, InputError.
    """
    from stages.report.stage import work

    return work(files, Output.at(output), config, progress)
