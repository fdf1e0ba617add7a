"""`lunargr evaluate`: measured against rendered crops of one split, for the learned model and its baselines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.evaluate.config import Config, HeldOutConfig, input_files, targets

__all__ = ["Config", "HeldOutConfig", "run", "run_held_out"]


@runner.stage(reads=input_files, writes=targets, in_parts=True)
def run(
    pairs: Path,
    checkpoints: Path | Sequence[Path],
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> dict[str, Any]:
    """Evaluate a checkpoint, or several training runs of one model, on a split of a pairs file; returns what the JSON holds.

    Writes the evaluation artefact, the JSON beside it, and figures where asked.
    Raises ConfigError or ArtefactError before anything is written.
    """
    from stages.evaluate.stage import work

    several = [checkpoints] if isinstance(checkpoints, Path) else list(checkpoints)
    return work(pairs, several, Output.at(output), config, progress)


@runner.stage(writes=targets)
def run_held_out(
    pairs: Path,
    maps: Sequence[Path],
    output: Output | Path,
    config: HeldOutConfig,
    progress: Progress = show_nothing,
) -> dict[str, Any]:
    """Score every pair of the split whose image had no part in one of the maps; returns what the JSON holds.

    maps : of `lunargr albedo`, such as those of all folds; a pair is scored on the first that its image did not make.
    Raises LunargrError.
    """
    from stages.evaluate.held_out_images import work

    return work(pairs, maps, Output.at(output), config, progress)
