"""infer for a scene or any DEM, which is put on a metric grid first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.locks import scratch_path
from schemas.files.outputs import Output, map_targets
from stages import infer, ingest
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing

if TYPE_CHECKING:
    from stages.common.runner.job import Job
    from stages.infer.stage import Summary


@dataclass(frozen=True)
class Config:
    """infer : its settings; body : of a DEM, by name or its radius in metres, None for the Moon"""

    infer: infer.Config
    body: str | None = None


@runner.stage(writes=lambda call: map_targets(call.output, runner.as_geotiff(call.config.infer)), in_parts=True)
def run(
    terrain: Path,
    checkpoint: Path,
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> Summary:
    """Write ``svbrdf.h5`` for a scene.h5 or a DEM that GDAL reads. Raises LunargrError."""
    output = Output.at(output)
    gridding = _gridding(terrain, checkpoint, config)
    if gridding is None:
        return infer.run(terrain, checkpoint, output, config.infer, say, progress)
    with scratch_path(output.file, "grid") as scene:
        ingest.run(terrain, None, scene, gridding, progress=progress)
        return infer.run(scene, checkpoint, output, config.infer, say, progress)


def in_parts(job: Job, terrain: Path, checkpoint: Path, config: Config) -> Summary:
    """The same in parts, on a grid that lies among them."""
    from stages.infer.stage import in_parts

    gridding, scene = _gridding(terrain, checkpoint, config), terrain
    if gridding is not None:
        scene = job.file("scene.h5")
        if not scene.exists():
            ingest.run(terrain, None, scene, gridding, progress=job.progress)
    return in_parts(replace(job, package="stages.infer"), scene, checkpoint, config.infer)


def _gridding(terrain: Path, checkpoint: Path, config: Config) -> ingest.Config | None:
    """How a DEM is put on a grid; None for a scene, which has one. Raises GeometryError for another body than its own."""
    from schemas.files.user_files import check_file
    from schemas.reading import is_artefact

    check_file(terrain, "scene.h5 or a DEM")
    if is_artefact(terrain):
        from stages.infer.terrain import check_body

        check_body(terrain, config.body)
        return None
    from stages.network.predictor import load_predictor

    gsd = None if config.infer.any_gsd else load_predictor(checkpoint).gsd
    return ingest.Config(gsd=gsd, body=config.body or ingest.Config.body)
