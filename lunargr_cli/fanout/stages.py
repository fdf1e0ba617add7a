"""How each wide stage is cut into parts and put together again. Functions named ``*_part`` run on the workers."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lunargr_cli.fanout.job import Identity, Job, Work, open_job
from schemas import ConfigError, atomic_path
from schemas.files.companions import companions_of
from schemas.files.outputs import Output, Target, map_targets

# What a part holds where --parts does not say: some minutes of work on real data.
BANDS_OF_DEM, BANDS_OF_MAP, BANDS_OF_ALBEDO, PAIRS, SAMPLES = 8, 8, 1, 512, 4


def stage_part(path: Path, stage: str, inputs: Sequence[Path | None], config: Any) -> None:
    """Write one shard of what a stage makes of its inputs."""
    importlib.import_module(f"stages.{stage}").run(*inputs, Output(path, overwrite=True), config)


def map_part(path: Path, scene: Path, checkpoint: Path, config: Any) -> None:
    """Write one shard of svbrdf.h5; the whole map gets its GeoTIFF when the shards are merged."""
    stage_part(path, "infer", [scene, checkpoint], config)
    path.with_suffix(".tif").unlink(missing_ok=True)  # where one part is the whole


def run_ingest(dem: Path, images: Path | None, output: Output, config: Any, work: Work) -> Any:
    """scene.h5 from shards of the DEM's rows, and then from shards of its images on the grid that these give."""
    from schemas.reading import is_artefact
    from stages import ingest, merge

    dem, images = dem.resolve(), images and images.resolve()
    inputs = [dem] + ([images] if images else [])
    sources = ingest.source_files(images, config) if images else ()
    with _job(output, "ingest", config, inputs, sources, work) as job:
        grid = dem
        if not is_artefact(dem):
            bands = ingest.count_bands(dem, config)
            cut = _cut(config, work.parts or math.ceil(bands / BANDS_OF_DEM), bands)
            pieces = _fan(job, "dem", "ingest", [dem, None], cut)
            grid = job.file("grid.h5")
            if images is not None:
                merge.run(pieces, Output(grid, overwrite=True), merge.Config(virtual=True, inputs=(dem,)))
        if images is not None:
            number = len(ingest.image_names(images, config))
            cut = _cut(replace(config, gsd=None), work.parts or number, number)
            pieces = _fan(job, "images", "ingest", [grid, images], cut)
            ingest.check_positions(pieces, images, config)
        merge.run(pieces, output, merge.Config(inputs=tuple(inputs)), progress=job.progress)
    found = ingest.summarise(output.file)
    if images is not None:
        kept = {frame.image_id for frame in found.frames}
        found = replace(found, skipped=tuple(n for n in ingest.image_names(images, config) if n not in kept))
    return found


def run_sample(scene: Path, output: Output, config: Any, work: Work) -> Any:
    """crops.h5 from shards: each chooses all places, which is quick, and cuts out its share of the crops."""
    from stages import merge, sample

    scene = scene.resolve()
    with _job(output, "sample", config, [scene], (), work) as job:
        cut = _cut(config, work.parts or SAMPLES)
        pieces = _fan(job, "crops", "sample", [scene], cut)
        merge.run(pieces, output, merge.Config(inputs=(scene,)), progress=job.progress)
    return sample.read_audit(output.file)


def run_project(crops: Path, output: Output, config: Any, work: Work) -> Any:
    """pairs.h5 from shards of the crops."""
    from stages import merge, project

    crops = crops.resolve()
    if config.scene:
        config = replace(config, scene=str(Path(config.scene).resolve()))
    scene = project.scene_of(crops, config)
    with _job(output, "project", config, [crops, scene], project.source_files(crops), work) as job:
        pairs = project.count_pairs(crops)
        cut = _cut(config, work.parts or math.ceil(pairs / PAIRS), pairs)
        pieces = _fan(job, "pairs", "project", [crops], cut)
        merge.run(pieces, output, merge.Config(inputs=(crops, scene)), progress=job.progress)
    return project.summarise(output.file)


def run_infer(terrain: Path, checkpoint: Path, output: Output, config: Any, gridding: Any, work: Work) -> Any:
    """svbrdf.h5 from shards of the map's rows. gridding : ingest.Config for a raster, None for a scene"""
    from stages import infer, ingest, merge

    terrain, checkpoint = terrain.resolve(), checkpoint.resolve()
    more = {"gridding": gridding}
    with _job(
        output, "infer", config, [terrain, checkpoint], (), work, map_targets(output, config.geotiff), more
    ) as job:
        scene = terrain
        if gridding is not None:
            scene = job.file("scene.h5")
            if not scene.exists():
                ingest.run(terrain, None, scene, gridding, progress=job.progress)
        bands = infer.count_bands(scene, config)
        cut = _cut(config, work.parts or math.ceil(bands / BANDS_OF_MAP), bands)
        pieces = job.fan("map", map_part, [{"scene": scene, "checkpoint": checkpoint, "config": c} for c in cut])
        merge.run(pieces, output, merge.Config(inputs=(terrain, checkpoint)), progress=job.progress)
    return infer.summarise(output.file, len(pieces))


def run_albedo(svbrdf: Path, scene: Path, output: Output, config: Any, work: Work) -> Any:
    """A map with albedo: the images' calibration in one part, then shards of the map's rows."""
    from stages import albedo, merge

    svbrdf, scene = svbrdf.resolve(), scene.resolve()
    sources, targets = albedo.source_files(scene), map_targets(output, config.geotiff)
    with _job(output, "albedo", config, [svbrdf, scene], sources, work, targets) as job:
        files = {"svbrdf": svbrdf, "scene": scene}
        [calibration] = job.fan("calibration", calibration_part, [files | {"config": config}], ".json")
        bands = albedo.count_bands(svbrdf, scene, config)
        cut = _cut(config, work.parts or math.ceil(bands / BANDS_OF_ALBEDO), bands)
        pieces = job.fan("map", albedo_part, [files | {"config": c, "calibration": calibration} for c in cut])
        merge.run(pieces, output, merge.Config(inputs=(svbrdf, scene)), progress=job.progress)
    return albedo.summarise(output.file, scene)


def calibration_part(path: Path, svbrdf: Path, scene: Path, config: Any) -> None:
    """Fit the images' gains and offsets, which all shards share."""
    from stages import albedo

    albedo.calibrate_to(Output(path, overwrite=True), svbrdf, scene, config)


def albedo_part(path: Path, svbrdf: Path, scene: Path, config: Any, calibration: Path) -> None:
    """Write one shard of a map with albedo."""
    from stages import albedo

    albedo.run_calibrated(svbrdf, scene, calibration, Output(path, overwrite=True), config)
    path.with_suffix(".tif").unlink(missing_ok=True)  # where one part is the whole


def run_evaluate(pairs: Path, checkpoints: Sequence[Path], output: Output, config: Any, work: Work) -> Any:
    """evaluation.h5 from shards of the pairs."""
    from stages import evaluate

    pairs, checkpoints = pairs.resolve(), [c.resolve() for c in checkpoints]
    inputs = [pairs, *checkpoints, *([Path(config.extend)] if config.extend else [])]
    with _job(output, "evaluate", config, inputs, (), work) as job:
        return evaluate.run_in_parts(pairs, checkpoints, output, config, job.fan)


def run_diagnose(pairs: Path, checkpoint: Path | None, output: Output, config: Any, work: Work) -> dict[str, Any]:
    """The whole diagnosis as one part, since its steps depend on each other. Returns the content of its JSON file."""
    if output.path is None:
        raise ConfigError("diagnose: expected --output with --scheduler (the part lies beside it), found none.")
    pairs, checkpoint = pairs.resolve(), checkpoint and checkpoint.resolve()
    inputs = [pairs, *([checkpoint] if checkpoint else [])]
    named = ((output.path, "output"), (output.json, "json"), (output.report, "report"))
    targets = [Target(path, option) for path, option in named if path is not None]
    with _job(output, "diagnose", config, inputs, (), work, targets) as job:
        arguments = {"pairs": pairs, "checkpoint": checkpoint, "config": config}
        (piece,) = job.fan("diagnosis", diagnose_part, [arguments])
        for made, wanted in ((".json", output.json), (".html", output.report), (".h5", output.path)):
            if wanted is not None:
                with companions_of(output.path), atomic_path(wanted) as partial:
                    shutil.copyfile(piece.with_suffix(made), partial)
        return json.loads(piece.with_suffix(".json").read_text())


def diagnose_part(path: Path, pairs: Path, checkpoint: Path | None, config: Any) -> None:
    """Write diagnosis.h5, and its JSON and page beside it."""
    from stages import diagnose

    json_file, report = path.with_suffix(".json"), path.with_suffix(".html")
    diagnose.run(pairs, checkpoint, Output(path, overwrite=True, json=json_file, report=report), config)


def _cut(config: Any, count: int, most: int | None = None) -> list[Any]:
    count = max(1, count if most is None else min(count, most))
    return [replace(config, shard=(k, count)) for k in range(count)]


def _fan(job: Job, name: str, stage: str, inputs: Sequence[Path | None], configs: Sequence[Any]) -> list[Path]:
    """Have a stage run on its inputs once for each of the shards' configs; the parts in order."""
    return job.fan(name, stage_part, [{"stage": stage, "inputs": inputs, "config": config} for config in configs])


def _job(
    output: Output,
    stage: str,
    config: Any,
    inputs: Sequence[Path],
    sources: Sequence[Path],
    work: Work,
    targets: Sequence[Target] = (),
    more: dict[str, Any] | None = None,
) -> contextlib.AbstractContextManager[Job]:
    options = asdict(config) | {"parts": work.parts} | (more or {})
    return open_job(output, targets or [Target(output.file)], Identity(stage, options, inputs, sources), work)
