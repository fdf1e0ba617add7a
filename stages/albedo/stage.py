"""albedo: a factor on the I/F of a map, pixel by pixel, from all photographs that see the pixel: `svbrdf.h5` once more.

Blocks of the map are worked one after the other, each with all its images; what lies around a block and is read with it
is all that the bands of structure can see, so that blocks leave no seams.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import SCENE, SVBRDF, ArtefactError, ArtefactWriter, atomic_path, open_artefact
from schemas.files.outputs import Output
from schemas.provenance import sha256
from schemas.reading import read_config, read_strings
from stages import merge
from stages.albedo import calibrate_to
from stages.albedo.config import Config, Summary, used_frames
from stages.albedo.writing import Maps
from stages.common.arrays import Floats32
from stages.common.progress import Progress
from stages.common.runner.job import Job
from stages.common.runner.stage import as_geotiff
from stages.photographs.calibrate import COSINES, Calibration, read_calibration, write_calibration
from stages.photographs.copying import copy_map, kept_attributes, sizes_of
from stages.photographs.ground import Ground, open_ground
from stages.photographs.posterior import estimate, robust_mean
from stages.photographs.prior import terrain_variance
from stages.photographs.pyramid import HALO_PX, LEVELS
from stages.physics.maps.geotiff import write_geotiff
from stages.physics.maps.grid import read_grid
from stages.physics.maps.window import Box


def open_map(svbrdf: Path, scene: Path, config: Config) -> contextlib.AbstractContextManager[Ground]:
    """A map without albedo and the photographs that may enter. Raises LunargrError."""

    def check(file: h5py.File) -> None:
        if "albedo" in file:
            raise ArtefactError(
                f"{svbrdf}:/albedo: expected a map without albedo, found one that photographs were applied to already; "
                "start from the output of 'lunargr infer'."
            )

    return open_ground(svbrdf, scene, check, lambda frames, file: used_frames(frames, config))


def work(
    svbrdf: Path, scene: Path, calibration: Path | None, output: Output, config: Config, progress: Progress
) -> Summary:
    """See :func:`stages.albedo.run`."""
    with open_map(svbrdf, scene, config) as ground:
        if calibration:
            found = Calibration.from_text(read_calibration(calibration, _identity(svbrdf, scene, config), "albedo"))
        else:
            found = ground.calibrate(config.register, progress)
        ground.references.subtract_displacement(found.fields)
        sizes = sizes_of(ground.map) | {
            "frame": len(ground.references.frames),
            "band": LEVELS + 1,
            "incidence_bin": len(COSINES) - 1,
            "level": 2,
        }
        with ArtefactWriter(
            output.file,
            SVBRDF,
            sizes,
            config=asdict(config),
            inputs=[svbrdf, scene],
            attributes=kept_attributes(ground.map),
        ) as writer:
            blocks = ground.blocks(HALO_PX)
            own = blocks.own_rows(config.shard)
            if config.shard[1] > 1:
                writer.file.attrs["shard_rows"] = np.array(own, np.int64)
            copy_map(ground.map, writer, own)
            maps = Maps(writer, ground.references.frames, found)
            for block in blocks.within(own, progress):
                maps.put(block, *work_block(ground, found, block))
            maps.close()
            if as_geotiff(config):
                write_geotiff(output.geotiff_path, writer.file, read_grid(writer.file, output.file))
            return _summary(writer.file, config, scene)


def in_parts(job: Job, svbrdf: Path, scene: Path, _: None, config: Config) -> Summary:
    """The map: the images' calibration in one part, then shards of the map's rows."""
    files = {"svbrdf": svbrdf, "scene": scene, "config": config}
    [calibration] = job.fan("calibration", write_part, [files], ".json")
    bands = _count_bands(svbrdf, scene, config)
    pieces = job.shards("map", [svbrdf, scene, calibration], config, bands)
    whole = Output(job.output.file, overwrite=True, geotiff=job.output.geotiff)
    merge.run(pieces, whole, merge.Config(inputs=(svbrdf, scene)), progress=job.progress)
    return _summarise(job.output.file, scene)


def write_part(path: Path, svbrdf: Path, scene: Path, config: Config) -> None:
    """The calibration as a part."""
    calibrate_to(svbrdf, scene, Output(path, overwrite=True), config)


def calibrate_images(svbrdf: Path, scene: Path, output: Output, config: Config, progress: Progress) -> Calibration:
    """See :func:`stages.albedo.calibrate_to`."""
    with open_map(svbrdf, scene, config) as ground, atomic_path(output.file) as partial:
        found = ground.calibrate(config.register, progress)
        write_calibration(partial, found.as_text(), _identity(svbrdf, scene, config))
    return found


def _identity(svbrdf: Path, scene: Path, config: Config) -> dict[str, Any]:
    """The files and options that a calibration hangs on."""
    fold = list(config.fold) if config.fold else None
    options = {"leave_out": list(config.leave_out), "fold": fold, "register": config.register}
    return {"svbrdf": sha256(svbrdf), "scene": sha256(scene)} | options


def work_block(ground: Ground, calibration: Calibration, block: Box) -> tuple[Floats32, Floats32, NDArray[np.uint16]]:
    """(albedo, its standard deviation, number of images) of a block."""
    row, col, height, width = block
    rows, cols = ground.map["valid"].shape
    top, left = max(0, row - HALO_PX), max(0, col - HALO_PX)
    bottom, right = min(rows, row + height + HALO_PX), min(cols, col + width + HALO_PX)
    box = top, left, bottom - top, right - left
    references, images = ground.references, list[int]()
    ratio, confidence = np.zeros((2, len(references.overlapping(box)), *box[2:]), np.float32)
    for k in references.overlapping(box):
        observed = references.observe(k, box)
        if observed is not None:
            ratio[len(images)], confidence[len(images)] = calibration.ratio(k, observed)
            images.append(k)
    ratio, confidence = ratio[: len(images)], confidence[: len(images)]
    inner = np.s_[row - top : row - top + height, col - left : col - left + width]
    count = (confidence[:, *inner] > 0).sum(axis=0).astype(np.uint16)
    spread = calibration.spread.of(images)
    robust_mean(ratio, confidence, spread)
    log_albedo, std = estimate(ratio, confidence, spread, terrain_variance(ground.surface, box))
    albedo = np.exp(log_albedo[inner])
    albedo_std = albedo * std[inner]
    unknown = ground.map["valid"][row : row + height, col : col + width] == 0
    albedo[unknown], albedo_std[unknown], count[unknown] = np.nan, np.nan, 0
    return albedo, albedo_std, count


def _count_bands(svbrdf: Path, scene: Path, config: Config) -> int:
    """Rows of blocks on a map: more shards than these have nothing to do."""
    with open_map(svbrdf, scene, config) as ground:
        return ground.blocks(HALO_PX).bands


def _summarise(output: Path, scene: Path) -> Summary:
    """What a finished map holds, for the lines at the end."""
    with open_artefact(output, SVBRDF) as file:
        told = read_config(file)
        fold = told.get("fold")
        config = Config(tuple(told.get("leave_out", ())), tuple(fold) if fold else None)
        return _summary(file, config, scene)


def _summary(file: h5py.File, config: Config, scene: Path) -> Summary:
    """From at most half a million pixels, in few rows."""
    height, width = file["albedo"].shape
    first, last = (int(v) for v in file.attrs.get("shard_rows", (0, height)))
    rows = range(first, last, max(1, (last - first) // 64))
    step = max(1, math.ceil(len(rows) * width / 5e5))

    def sample(name: str) -> NDArray:
        return np.concatenate([file[name][r, ::step] for r in rows]) if len(rows) else np.zeros(0)

    albedo, std, count = sample("albedo"), sample("albedo_std"), sample("albedo_images")
    known = np.isfinite(albedo)
    seen = known & (count > 0)
    moments = (math.nan,) * 4
    if seen.any():
        low, high = np.percentile(albedo[seen], [1, 99])
        moments = float(albedo[seen].mean()), float(albedo[seen].std()), float(low), float(high)
    with open_artefact(scene, SCENE) as terrain:
        names = read_strings(terrain, "image_id")
    used = read_strings(file, "albedo_image_id")
    own = np.median(np.where(np.isfinite(file["albedo_image_std"][...]), file["albedo_image_std"][...], 0), axis=0)
    bands = zip(file["albedo_band_px"][...], file["albedo_band_std"][...], own, strict=True)
    return Summary(
        tuple(used),
        tuple(name for name in names if name not in used),
        float(seen.sum() / max(1, known.sum())),
        float(count[seen].mean()) if seen.any() else 0.0,
        moments,  # type: ignore[arg-type]
        float(np.median(std[seen])) if seen.any() else math.nan,
        tuple((float(a), float(b), float(c)) for a, b, c in bands),
    )
