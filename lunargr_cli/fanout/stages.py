"""How each wide stage is cut into parts and put together again. Functions named ``*_part`` run on the workers."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lunargr_cli.fanout.job import open_job
from schemas import ConfigError, atomic_path
from schemas.files.companions import companions_of
from schemas.files.outputs import check_output

# What a part holds where --parts does not say: some minutes of work on real data.
BANDS_OF_DEM, BANDS_OF_MAP, PAIRS, SAMPLES = 8, 8, 512, 4


def run_ingest(dem: Path, images: Path | None, output: Path, config: Any, parts: int | None, **how: Any) -> Any:
    """The DEM's rows, then each image by itself on the grid that these give."""
    from stages import ingest, merge

    dem, images = dem.resolve(), images and images.resolve()
    inputs = [dem] + ([images] if images else [])
    with _job(
        output, "ingest", config, parts, inputs, ingest.source_files(images, config) if images else (), how
    ) as job:
        grid = dem
        if not ingest.is_artefact(dem):
            bands = ingest.count_bands(dem, config)
            cut = _cut(config, parts or math.ceil(bands / BANDS_OF_DEM), bands)
            pieces = job.fan("dem", ingest_part, [{"dem": dem, "images": None, "config": c} for c in cut])
            grid = job.folder / "grid.h5"
            if images is not None:
                merge.run(pieces, grid, True, virtual=True, inputs=[dem])
        if images is not None:
            number = len(ingest.image_names(images, config))
            cut = _cut(replace(config, gsd=None), parts or number, number)
            pieces = job.fan("images", ingest_part, [{"dem": grid, "images": images, "config": c} for c in cut])
            ingest.check_positions(pieces, images, config)
        merge.run(pieces, output, how["overwrite"], job.progress, inputs=inputs)
    found = ingest.summarise(output)
    if images is not None:
        kept = {frame.image_id for frame in found.frames}
        found = replace(found, skipped=tuple(n for n in ingest.image_names(images, config) if n not in kept))
    return found


def ingest_part(path: Path, dem: Path, images: Path | None, config: Any) -> None:
    from stages import ingest

    ingest.run(dem, images, path, config, overwrite=True)


def run_sample(scene: Path, output: Path, config: Any, parts: int | None, **how: Any) -> Any:
    """Every part chooses all places, which is quick, and cuts out its share of the crops."""
    from stages import merge, sample

    scene = scene.resolve()
    with _job(output, "sample", config, parts, [scene], (), how) as job:
        cut = _cut(config, parts or SAMPLES)
        pieces = job.fan("crops", sample_part, [{"scene": scene, "config": c} for c in cut])
        merge.run(pieces, output, how["overwrite"], job.progress, inputs=[scene])
    return sample.read_audit(output)


def sample_part(path: Path, scene: Path, config: Any) -> None:
    from stages import sample

    sample.run(scene, path, config, overwrite=True)


def run_project(crops: Path, output: Path, config: Any, parts: int | None, **how: Any) -> Any:
    from stages import merge, project

    crops = crops.resolve()
    if config.scene:
        config = replace(config, scene=str(Path(config.scene).resolve()))
    scene = project.scene_of(crops, config)
    with _job(output, "project", config, parts, [crops, scene], project.source_files(crops), how) as job:
        pairs = project.count_pairs(crops)
        cut = _cut(config, parts or math.ceil(pairs / PAIRS), pairs)
        pieces = job.fan("pairs", project_part, [{"crops": crops, "config": c} for c in cut])
        merge.run(pieces, output, how["overwrite"], job.progress, inputs=[crops, scene])
    return project.summarise(output)


def project_part(path: Path, crops: Path, config: Any) -> None:
    from stages import project

    project.run(crops, path, config, overwrite=True)


def run_infer(
    terrain: Path,
    checkpoint: Path,
    output: Path,
    config: Any,
    gridding: Any,
    geotiff: Path | None,
    parts: int | None,
    **how: Any,
) -> Any:
    """gridding : the ingest.Config for a terrain that is a raster, None for a scene"""
    from stages import infer, ingest, merge

    terrain, checkpoint, tiff = terrain.resolve(), checkpoint.resolve(), geotiff or output.with_suffix(".tif")
    with _job(output, "infer", config, parts, [terrain, checkpoint], (), how, {"gridding": gridding}) as job:
        replace_tiff = how["overwrite"] or job.again  # an interrupted run may have got as far as that
        if config.geotiff:
            check_output(tiff, [terrain, checkpoint, output], replace_tiff)
        scene = terrain
        if gridding is not None:
            scene = job.folder / "scene.h5"
            if not scene.exists():
                ingest.run(terrain, None, scene, gridding, progress=job.progress)
        bands = infer.count_bands(scene, config)
        cut = _cut(config, parts or math.ceil(bands / BANDS_OF_MAP), bands)
        pieces = job.fan("map", infer_part, [{"scene": scene, "checkpoint": checkpoint, "config": c} for c in cut])
        if config.geotiff and replace_tiff:
            tiff.unlink(missing_ok=True)
        merge.run(pieces, output, how["overwrite"], job.progress, inputs=[terrain, checkpoint], geotiff=tiff)
    return infer.summarise(output, len(pieces))


def infer_part(path: Path, scene: Path, checkpoint: Path, config: Any) -> None:
    from stages import infer

    infer.run(scene, checkpoint, path, config, overwrite=True)
    path.with_suffix(".tif").unlink(missing_ok=True)  # where one part is the whole


def run_evaluate(
    pairs: Path,
    checkpoint: Path,
    output: Path,
    config: Any,
    extend: Path | None,
    json_file: Path | None,
    figures: Path | None,
    **how: Any,
) -> Any:
    from stages import evaluate

    pairs, checkpoint, extend = pairs.resolve(), checkpoint.resolve(), extend and extend.resolve()
    inputs = [pairs, checkpoint, *([extend] if extend else [])]
    with _job(output, "evaluate", config, None, inputs, (), how) as job:
        return evaluate.run(
            pairs,
            checkpoint,
            output,
            config,
            extend=extend,
            json_file=json_file,
            figures=figures,
            overwrite=how["overwrite"],
            progress=job.progress,
            fan=job.fan,
        )


def run_diagnose(
    pairs: Path,
    checkpoint: Path | None,
    output: Path | None,
    json_file: Path | None,
    report: Path | None,
    config: Any,
    **how: Any,
) -> dict[str, Any]:
    """One part: a search uses a few hundred pairs and decides one thing after the other. Returns the JSON's content."""
    if output is None:
        raise ConfigError("diagnose: expected --output with --scheduler (the part lies beside it), found none.")
    pairs, checkpoint = pairs.resolve(), checkpoint and checkpoint.resolve()
    inputs = [pairs, *([checkpoint] if checkpoint else [])]
    for path in (json_file, report):
        if path is not None:
            check_output(path, inputs, how["overwrite"])
    with _job(output, "diagnose", config, None, inputs, (), how) as job:
        arguments = {"pairs": pairs, "checkpoint": checkpoint, "config": config}
        (piece,) = job.fan("diagnosis", diagnose_part, [arguments])
        for made, wanted in ((".json", json_file), (".html", report), (".h5", output)):
            if wanted is not None:
                with companions_of(output), atomic_path(wanted) as partial:
                    shutil.copyfile(piece.with_suffix(made), partial)
        return json.loads(piece.with_suffix(".json").read_text())


def diagnose_part(path: Path, pairs: Path, checkpoint: Path | None, config: Any) -> None:
    from stages import diagnose

    texts = path.with_suffix(".json"), path.with_suffix(".html")
    diagnose.run(pairs, checkpoint, config, path, *texts, overwrite=True)


def _cut(config: Any, count: int, most: int | None = None) -> list[Any]:
    count = max(1, count if most is None else min(count, most))
    return [replace(config, shard=(k, count)) for k in range(count)]


def _job(
    output: Path,
    stage: str,
    config: Any,
    parts: int | None,
    inputs: Sequence[Path],
    sources: Sequence[Path],
    how: dict[str, Any],
    more: dict[str, Any] | None = None,
) -> Any:
    options = asdict(config) | {"parts": parts} | (more or {})
    return open_job(output, stage, options, inputs, sources=sources, **how)
