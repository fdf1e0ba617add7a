"""project: orthorectify the images onto the crops and add Sun, camera and horizon: `pairs.h5`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.errors import ConfigError
from schemas.files.outputs import Output, Target
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.project.config import Config

if TYPE_CHECKING:
    from stages.project.summary import Summary

__all__ = ["Config", "run"]


def _files(call: runner.Call) -> list[Path]:
    return [*call.files, *([Path(call.config.scene)] if call.config.scene else [])]


def _targets(call: runner.Call) -> Iterator[Target]:
    yield Target(call.output.file)
    if call.output.shifts:
        yield Target(call.output.shifts, "shifts", "the table of shifts")


def _check(call: runner.Call) -> None:
    call.config.check()
    if call.output.shifts and call.config.register is None:
        raise ConfigError("`shifts`: expected together with `register`, which finds them.")
    if call.output.shifts and call.output.in_parts:
        raise ConfigError("`shifts`: parts do not keep the blocks' own shifts; leave out `scheduler` and `resume`.")


@runner.stage(reads=_files, writes=_targets, check=_check, in_parts=True)
def run(
    crops: Path, output: Output | Path, config: Config, say: Say = say_nothing, progress: Progress = show_nothing
) -> Summary:
    """Write ``pairs.h5``. Raises ArtefactError, ConfigError, InputError or GeometryError; then nothing is written."""
    from stages.project.stage import work

    return work(crops, Output.at(output), config, progress)
