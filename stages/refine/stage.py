"""refine: heights and albedo of a map from all its photographs, block by block: `svbrdf.h5` once more.

What lies around a block and is read with it is as far as errors of heights hang together; draws of a block depend on its
place alone, so that parts give the bytes of the whole.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch

from schemas import SVBRDF, ArtefactError, ArtefactWriter, atomic_path, open_artefact
from schemas.files.outputs import Output
from schemas.provenance import sha256
from schemas.reading import read_config, read_strings
from stages import merge
from stages.common.arrays import Floats32
from stages.common.progress import Progress
from stages.common.runner.job import Job
from stages.common.runner.stage import as_geotiff
from stages.photographs.calibrate import read_calibration, write_calibration
from stages.photographs.copying import copy_map, kept_attributes, sizes_of
from stages.photographs.ground import Ground, open_ground
from stages.physics.images.spectrum import WAVELENGTHS, waves
from stages.physics.maps.geotiff import write_geotiff
from stages.physics.maps.grid import read_grid
from stages.physics.maps.window import Box, Window
from stages.refine import calibrate_to
from stages.refine.config import Config, Summary
from stages.refine.fit import fit, variances
from stages.refine.judge import Learned, find_out
from stages.refine.learn import SEED
from stages.refine.patch import Patch

HALO_PX = 64
STACK_PX = 12 << 20  # pixels of all images of a block: 0.6 GB
FADE_PX = 8.0  # from the last pixel that an image shows, over which a correction ends
MAPS = ("elevation", "elevation_correction", "elevation_std", "albedo", "albedo_std", "albedo_alone")
CHANGED = (*MAPS, "albedo_interval_68", "albedo_interval_95", "albedo_interval_shadow")


def open_map(svbrdf: Path, scene: Path) -> AbstractContextManager[Ground]:
    """A map with albedo and the photographs that made it. Raises LunargrError."""

    def check(file: h5py.File) -> None:
        if "elevation_correction" in file or "albedo" not in file:
            found = "none" if "albedo" not in file else "one that was refined already"
            raise ArtefactError(
                f"{svbrdf}: expected a map with albedo, found {found}; start from the output of 'lunargr albedo'."
            )

    def choose(frames: Any, file: h5py.File) -> list[bool]:
        used = read_strings(file, "albedo_image_id")
        missing = sorted({*used} - {frame.image_id for frame in frames})
        if missing:
            raise ArtefactError(
                f"{scene}: expected the images that made the albedo of {svbrdf}, found no '{missing[0]}'; "
                "name the scene that 'lunargr albedo' was given."
            )
        return [frame.image_id in used for frame in frames]

    return open_ground(svbrdf, scene, check, choose)


def work(
    svbrdf: Path, scene: Path, calibration: Path | None, output: Output, config: Config, progress: Progress
) -> Summary:
    """See :func:`stages.refine.run`."""
    with open_map(svbrdf, scene) as ground, _fast():
        learned = _learned(ground, calibration, progress)
        sizes = sizes_of(ground.map) | {"wavelength": len(WAVELENGTHS), "bound": 3}
        with ArtefactWriter(
            output.file,
            SVBRDF,
            sizes,
            config=asdict(config),
            inputs=[svbrdf, scene],
            attributes=kept_attributes(ground.map) | {"refine_reason": learned.reason},
        ) as writer:
            blocks = ground.blocks(HALO_PX, STACK_PX)
            own = blocks.own_rows(config.shard)
            if config.shard[1] > 1:
                writer.file.attrs["shard_rows"] = np.array(own, np.int64)
            copy_map(ground.map, writer, own, but=CHANGED)
            targets = [writer.dataset(name) for name in MAPS]
            for block in blocks.within(own, progress):
                part = Window(*block).part
                for target, values in zip(targets, work_block(ground, learned, block, config.draws), strict=True):
                    target[part] = values
            _write_learned(writer, learned)
            if as_geotiff(config):
                write_geotiff(output.geotiff_path, writer.file, read_grid(writer.file, output.file))
            return summarise(writer.file)


def in_parts(job: Job, svbrdf: Path, scene: Path, _: None, config: Config) -> Summary:
    """The map: what is learned of all images in one part, then shards of the map's rows."""
    files = {"svbrdf": svbrdf, "scene": scene, "config": config}
    [calibration] = job.fan("calibration", write_part, [files], ".json")
    with open_map(svbrdf, scene) as ground:
        bands = ground.blocks(HALO_PX, STACK_PX).bands
    pieces = job.shards("map", [svbrdf, scene, calibration], config, bands)
    whole = Output(job.output.file, overwrite=True, geotiff=job.output.geotiff)
    merge.run(pieces, whole, merge.Config(inputs=(svbrdf, scene)), progress=job.progress)
    with open_artefact(job.output.file, SVBRDF) as file:
        return summarise(file)


def write_part(path: Path, svbrdf: Path, scene: Path, config: Config) -> None:
    """What is learned of all images, as a part."""
    calibrate_to(svbrdf, scene, Output(path, overwrite=True), config)


def calibrate_images(svbrdf: Path, scene: Path, output: Output, config: Config, progress: Progress) -> Learned:
    """See :func:`stages.refine.calibrate_to`."""
    with open_map(svbrdf, scene) as ground, _fast(), atomic_path(output.file) as partial:
        learned = _learned(ground, None, progress)
        write_calibration(partial, learned.as_text(), _identity(ground))
    return learned


def _learned(ground: Ground, calibration: Path | None, progress: Progress) -> Learned:
    if calibration is None:
        learned = find_out(ground, read_config(ground.map).get("register"), progress)
    else:
        learned = Learned.from_text(read_calibration(calibration, _identity(ground), "refine"))
    ground.references.subtract_displacement(learned.calibration.fields)
    return learned


def _identity(ground: Ground) -> dict[str, Any]:
    """The files that what is learned hangs on."""
    return {"svbrdf": sha256(ground.svbrdf), "scene": sha256(ground.scene)}


@contextlib.contextmanager
def _fast() -> Iterator[None]:
    """Within this block numbers below 1e-38 are 0 on this thread: exponentials of Hapke's model are a tenth as fast with them."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def work_block(ground: Ground, learned: Learned, block: Box, draws: int) -> list[Floats32]:
    """MAPS of a block, (height, width) each."""
    part = Window(*block).part
    dem, albedo, std = (ground.map[name][part] for name in ("elevation", "albedo", "albedo_std"))
    kept = [dem, np.where(np.isfinite(dem), np.float32(0), np.nan), np.full_like(dem, np.nan), albedo, std, albedo]
    if learned.reason:
        return kept
    box = Window(*block).padded(HALO_PX, ground.map["valid"].shape)
    patch = Patch(ground, learned.calibration, box)
    if not patch.photographs:
        return kept
    fields, posterior, evidence = fit(patch, patch.start(), learned.priors, learned.noise)
    rng = np.random.default_rng([SEED, *block[:2]])
    variance = variances(learned.priors, (waves(posterior.draw(rng)) for _ in range(draws)), evidence.doubt)
    inner = Window(*block).within(box).part
    seen = evidence.products[0] > 0
    share = _share(seen)[inner]
    heights, heights_std = (share * fields[0][inner]), np.sqrt(variance[0][inner])
    found = np.exp(fields[1][inner])
    factor = np.where(seen[inner], found, albedo)
    factor_std = np.where(seen[inner], found * np.sqrt(variance[1][inner]), std)
    unknown = ~np.isfinite(albedo)
    for values in (factor, factor_std, heights, heights_std):
        values[unknown if values is not heights else ~np.isfinite(dem)] = np.nan
    heights[unknown & np.isfinite(dem)] = 0
    return [v.astype(np.float32) for v in (dem + heights, heights, heights_std, factor, factor_std, albedo)]


def _share(seen: Any) -> Floats32:
    """(H, W) of the correction that holds: all where images show the ground, none FADE_PX away from there."""
    if seen.all():
        return np.ones(seen.shape, np.float32)
    away = cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, 5)
    return np.maximum(0, 1 - away / np.float32(FADE_PX)).astype(np.float32)


def _write_learned(writer: ArtefactWriter, learned: Learned) -> None:
    found = learned.calibration
    writer.write("albedo_interval_68", found.interval[0])
    writer.write("albedo_interval_95", found.interval[1])
    writer.write("albedo_interval_shadow", found.shadow)
    writer.write("refine_wavelength_px", WAVELENGTHS)
    writer.write("refine_elevation_wave_std", np.sqrt(learned.priors.heights.variance))
    writer.write("refine_albedo_wave_std", np.sqrt(learned.priors.albedo.variance))
    writer.write("refine_trust", learned.priors.trust.variance)
    writer.write("refine_gain_percent", np.array(learned.gain))


def summarise(file: h5py.File) -> Summary:
    """What a finished map holds, for the lines at the end, from at most half a million pixels."""
    height, width = file["elevation_correction"].shape
    step = max(1, math.ceil(math.sqrt(height * width / 5e5)))
    correction, std = (file[name][::step, ::step] for name in ("elevation_correction", "elevation_std"))
    gain = tuple(float(v) for v in file["refine_gain_percent"][...])
    names = ("refine_wavelength_px", "refine_elevation_wave_std", "refine_albedo_wave_std", "refine_trust")
    waves = tuple(tuple(float(v) for v in row) for row in zip(*(file[n][...] for n in names), strict=True))
    known = np.isfinite(correction)
    rms = float(np.sqrt(np.square(correction[known], dtype=float).mean())) if known.any() else math.nan
    middle = float(np.median(std[np.isfinite(std)])) if np.isfinite(std).any() else math.nan
    images = tuple(read_strings(file, "albedo_image_id"))
    return Summary(images, str(file.attrs["refine_reason"]), gain, rms, middle, waves)  # type: ignore[arg-type]
