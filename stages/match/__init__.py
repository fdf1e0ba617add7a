"""`lunargr match`: do features of rendered images lie where those of the measured image lie?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from schemas.files.outputs import Output, Target
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.match.config import Config, figure_files

__all__ = ["Config", "run"]


def _files(call: runner.Call) -> list[Path | None]:
    return [*call.files, call.config.features_model, call.config.lightglue_model]


def _targets(call: runner.Call) -> Iterator[Target]:
    if json_file := call.output.json or call.output.path:
        yield Target(json_file, "json")
    if call.output.figures:
        yield from (Target(path, "figures") for path in figure_files(call.output.figures, call.config))


@runner.stage(reads=_files, writes=_targets, main=lambda call: call.output.json or call.output.path)
def run(
    files: list[Path],
    output: Output | Path | None,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> dict[str, Any]:
    """Match every comparison with every matcher; returns what the JSON holds. Raises LunargrError.

    output : the JSON and the folder of pictures, where they are wanted; a bare path is the JSON's
    """
    from stages.match.stage import work

    return work(files, Output.at(output), config, say, progress)
