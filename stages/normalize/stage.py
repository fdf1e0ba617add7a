"""normalize: the images of a scene at a standard geometry with the terrain's angles, and mosaics of them: normalized.h5.

Blocks of the map are worked one after the other, each with all its images; what lies around a block and is read with it is
as wide as weights fade, so that blocks leave no edges.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas import NORMALIZED, SCENE, SVBRDF, ArtefactWriter, ConfigError, InputError, open_artefact
from schemas.files.outputs import Output
from stages.common.arrays import Floats32
from stages.common.progress import Progress
from stages.common.runner.stage import as_geotiff
from stages.normalize.config import Config, Summary
from stages.normalize.factor import GOOD, UNSEEN, Normaliser, placed
from stages.normalize.levels import Levels, compare_angles, find_levels, take_samples
from stages.normalize.mosaic import FADE_PX, Layer, Mosaic, choose_layers, combine, fading_weight
from stages.normalize.writing import Maps, attributes_of
from stages.physics.bodies.spheres import find_body
from stages.physics.images.references import References, open_references
from stages.physics.images.registered import register
from stages.physics.images.table import Frame, load_frames
from stages.physics.images.windows import Blocks, choose_blocks
from stages.physics.maps.geotiff import write_geotiff
from stages.physics.maps.grid import check_same_grid
from stages.physics.maps.window import Box, Window
from stages.physics.photometry.published import ParameterSet, find_reflectance, sets_by_wavelength
from stages.physics.terrain.surface import open_surface, uniform_coefficients


@dataclass(frozen=True)
class Ground:
    """The images of a scene, how they are normalised, and whether they are in I/F or DN."""

    references: References
    normaliser: Normaliser
    units: str

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the map."""
        grid = self.references.surface.grid
        return grid.height, grid.width

    @property
    def layers(self) -> list[Layer]:
        """The mosaics to make."""
        return choose_layers(self.references.frames, self.normaliser.config.phase_bins_deg)

    @property
    def blocks(self) -> Blocks:
        """The blocks of the map."""
        return choose_blocks(self.shape, self.references.overlapping, FADE_PX)


@dataclass(frozen=True)
class Block:
    """What a block shows. normal, std, mask : (n, h, w) of the images ``images``; mosaics : one of each layer"""

    images: list[int]
    normal: Floats32
    std: Floats32
    mask: NDArray[np.uint8]
    mosaics: list[Mosaic]


def work(scene: Path, svbrdf: Path | None, output: Output, config: Config, progress: Progress) -> Summary:
    """See :func:`stages.normalize.run`."""
    with contextlib.ExitStack() as stack:
        ground = stack.enter_context(open_ground(scene, svbrdf, config))
        references = ground.references
        if config.register:
            references.subtract_displacement(register(references, config.register, progress))
        samples = take_samples(references, ground.shape, ground.normaliser, progress)
        if not samples:
            raise InputError(
                f"{scene}: expected images with sunlit pixels within the limits of incidence and emission, found none."
            )
        layers = ground.layers
        groups = [
            min(next(layer.images for layer in layers if k in layer.images)) for k in range(len(references.frames))
        ]
        levels = find_levels(samples, groups, ground.units, config.level)
        blocks = ground.blocks
        own = blocks.own_rows(config.shard)
        writer = stack.enter_context(
            ArtefactWriter(
                output.file,
                NORMALIZED,
                Maps.sizes(references, len(layers)),
                config=asdict(config),
                inputs=[scene, *([svbrdf] if svbrdf else [])],
                attributes=attributes_of(references.surface, config, ground.units),
            )
        )
        maps = Maps(writer, own if config.shard[1] > 1 else None)
        for box in blocks.within(own, progress):
            maps.put(box, work_block(ground, levels, box))
        maps.close(references, levels, layers)
        if as_geotiff(config):
            write_geotiff(output.geotiff_path, writer.file, references.surface.grid)
        return maps.summarise(references.frames, levels, ground.units, compare_angles(samples, references.frames))


@contextlib.contextmanager
def open_ground(scene: Path, svbrdf: Path | None, config: Config) -> Iterator[Ground]:
    """The images of a scene that may enter. Raises LunargrError."""
    with contextlib.ExitStack() as stack:
        terrain = stack.enter_context(open_artefact(scene, SCENE))
        if svbrdf is not None:
            check_same_grid(svbrdf, stack.enter_context(open_artefact(svbrdf, SVBRDF)), scene, terrain)
        frames = load_frames(terrain, scene)
        body = find_body(str(terrain.attrs["body_radius_m"]))
        sets = sets_by_wavelength(config.model or "")
        model = next(iter(sets.values())).name if sets else config.model
        surface = stack.enter_context(open_surface(svbrdf or scene, model, config.parameters, body))
        references = stack.enter_context(open_references(scene, terrain, surface, _used(scene, frames, config)))
        references.reads_angles = True
        without = [frame.image_id for frame in references.frames if frame.angles is None]
        if config.angles == "file" and without:
            raise ConfigError(
                f"`angles`: expected files of angles in column 'angles' of the image table, found none for {', '.join(without)}."
            )
        units = {frame.units for frame in references.frames}
        if len(units) > 1:
            raise InputError(f"{scene}: expected one kind of units, found both 'iof' and 'dn'; ingest them apart.")
        by_image = [_of_wavelength(frame, sets, config) for frame in references.frames] if sets else []
        yield Ground(references, Normaliser(surface, config, by_image), units.pop())


def _of_wavelength(frame: Frame, sets: Mapping[float, ParameterSet], config: Config) -> NDArray[np.float32]:
    """(C,) of the set whose wavelength is nearest to the image's."""
    if math.isnan(frame.wavelength_nm):
        raise ConfigError(
            f"image '{frame.image_id}': expected a known wavelength, to choose a set of {config.model}, found none; "
            f"name one set, such as {next(iter(sets.values())).name}."
        )
    nearest = sets[min(sets, key=lambda nm: abs(nm - frame.wavelength_nm))]
    return uniform_coefficients(*find_reflectance(nearest.name), config.parameters)


def _used(scene: Path, frames: Sequence[Frame], config: Config) -> list[bool]:
    names = [frame.image_id for frame in frames]
    for name in config.leave_out:
        if name not in names:
            raise ConfigError(f"`leave_out`: expected an image of the scene ({', '.join(names)}), found '{name}'.")
    return [name not in config.leave_out for name in names]


def work_block(ground: Ground, levels: Levels, block: Box) -> Block:
    """The images of a block at the standard geometry, and their mosaics."""
    references, normaliser = ground.references, ground.normaliser
    around = Window(*block).padded(FADE_PX, ground.shape)
    inner = Window(*block).within(around).part
    planes: list[NDArray] = []
    images, masks = list[int](), list[NDArray[np.uint8]]()
    for k in references.overlapping(around):
        seen = references.see(k, around)
        if seen is None:
            continue
        mask, angles = normaliser.mask(seen), normaliser.angles(seen)
        factor, spread = normaliser.factor(k, seen, mask == GOOD)
        normal = (seen.measured - np.float32(levels.offset[k])) / np.float32(levels.gain[k]) * factor
        own_error = levels.deviation(k, np.cos(np.radians(angles["incidence_deg"])))
        std = np.abs(normal) * np.hypot(own_error, spread)
        whole = placed(np.stack([normal, std, angles["phase_deg"]]), seen.box, around)
        fade = fading_weight(np.isfinite(whole[0]))
        images.append(k)
        masks.append(placed(mask, seen.box, around, UNSEEN)[inner])
        planes.append(np.stack([*whole, fade])[(slice(None), *inner)].astype(np.float32))
    size = (4, len(images), *block[2:])
    normal, std, phase, fade = np.stack(planes, axis=1) if images else np.full(size, np.nan, np.float32)
    mosaics = []
    for layer in ground.layers:
        own = np.array([k in layer.images for k in images], bool)
        inside = (phase[own] >= layer.low) & (phase[own] < layer.high)
        mosaics.append(combine(np.where(inside, normal[own], np.nan), std[own], fade[own]))
    return Block(images, normal, std, np.stack(masks) if masks else np.zeros(size[1:], np.uint8), mosaics)
