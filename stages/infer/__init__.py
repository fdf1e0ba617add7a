"""infer: coefficient maps for a DEM.

stage: from files to files; windows: where the map is cut; terrain: the DEM in rows; parallel: threads; writing: the map
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.infer.config import Config

if TYPE_CHECKING:
    from stages.infer.stage import Summary

__all__ = ["Config", "run"]


@runner.stage(writes=runner.the_map, in_parts=True)
def run(
    scene: Path,
    checkpoint: Path,
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> Summary:
    """Write ``svbrdf.h5`` and, if wanted, a cloud-optimised GeoTIFF. Raises ConfigError, ArtefactError."""
    from stages.infer.stage import work

    return work(scene, checkpoint, Output.at(output), config, progress)
