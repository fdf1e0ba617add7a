"""train: a U-Net that predicts reflectance from terrain.

stage: from files to files; start: the uniform surface that it begins at; training: what every step works with;
epoch, steps: one pass over the pairs; processes: several of them; resume: an unfinished run; deviations: of the maps
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.errors import ConfigError
from schemas.files.outputs import Output, Target
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.train.config import Config, state_path

if TYPE_CHECKING:
    from stages.train.stage import Summary

__all__ = ["Config", "run"]


def _files(call: runner.Call) -> list[Path]:
    return [*call.files, *([Path(call.config.extend)] if call.config.extend else [])]


def _targets(call: runner.Call) -> list[Target]:
    path, state = call.output.file, state_path(call.output)
    if state.exists() and not (call.output.resume or call.output.overwrite):
        raise ConfigError(
            f"{state}: the state of an unfinished run; add `resume` to go on with it, or `overwrite` to start anew."
        )
    return [Target(path), Target(state, name=f"the state of the unfinished {path.name}", state=True)]


@runner.stage(reads=_files, writes=_targets, check=lambda call: call.config.check())
def run(
    pairs: Path, output: Output | Path, config: Config, say: Say = say_nothing, progress: Progress = show_nothing
) -> Summary:
    """Write ``checkpoint.h5``: the weights of the best validation epoch. Raises ConfigError, InputError, ArtefactError.

    After every epoch the whole state is written beside the output; ``resume`` goes on from it to the same result.
    """
    from stages.train.stage import work

    return work(pairs, Output.at(output), config, say, progress)
