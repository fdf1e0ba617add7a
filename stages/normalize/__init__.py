"""Stage normalize. stage: from files to files; levels: gains and errors of the images; mosaic: many images to one; writing: the file."""

from __future__ import annotations

from pathlib import Path

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, show_nothing
from stages.normalize.config import Config, Summary, check

__all__ = ["Config", "Summary", "run"]


@runner.stage(
    writes=runner.the_map,
    check=lambda call: check(call.config, call.arguments["svbrdf"] is not None),
)
def run(
    scene: Path, svbrdf: Path | None, output: Output | Path, config: Config, progress: Progress = show_nothing
) -> Summary:
    """Write the images at the standard geometry and their mosaics. svbrdf : None for the model of ``config``. Raises LunargrError."""
    from stages.normalize.stage import work

    return work(scene, svbrdf, Output.at(output), config, progress)
