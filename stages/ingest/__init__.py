"""ingest: a DEM on a metric grid, and the ground that images show of it.

stage: from files to files; plan: the choice of the grid; elevation: the DEM on it; validity: masks of the images
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.ingest.config import Config

if TYPE_CHECKING:
    from stages.ingest.stage import Summary

__all__ = ["Config", "run"]


@runner.stage(in_parts=True)
def run(
    dem: Path,
    images: Path | None,
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> Summary:
    """Write ``scene.h5``. Raises InputError, GeometryError or ConfigError; then nothing is written.

    dem : a raster, or a scene whose grid and elevations are taken as they are. Shards are cut in two steps: of a raster
    without images, its rows; of a scene with images, the images.
    """
    from stages.ingest.stage import work

    return work(dem, images, Output.at(output), config, say, progress)
