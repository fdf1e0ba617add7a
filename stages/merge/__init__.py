"""merge: one artefact from its parts. stage: from files to files; parts: checks of the parts; joining: of variables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output, Target, map_targets
from stages.common import runner
from stages.common.progress import Progress, show_nothing
from stages.merge.config import Config

if TYPE_CHECKING:
    from schemas import Schema

__all__ = ["Config", "run"]


def _files(call: runner.Call) -> list[Path]:
    """Parts in a run's own folder beside its output go with that folder."""
    return [path for path in call.files if f"{call.output.file.name}.parts" not in path.parts]


def _targets(call: runner.Call) -> list[Target]:
    from stages.merge.parts import wants_geotiff

    return map_targets(call.output, wants_geotiff(call.files, call.config))


@runner.stage(reads=_files, writes=_targets)
def run(
    parts: Sequence[Path],
    output: Output | Path,
    config: Config = Config(),
    progress: Progress = show_nothing,
) -> Schema:
    """Join ``parts``, in the order of their shards. Raises ArtefactError where they are not parts of one whole.

    The GeoTIFF of a map is written too, if its parts want one and it is no view of them.
    """
    from stages.merge.stage import work

    return work(parts, Output.at(output), config, progress)
