"""project: pairs.h5, image by image and crop by crop."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import CROPS, PAIRS, ArtefactWriter, InputError, open_artefact
from schemas.files.outputs import Output
from stages import merge
from stages.common.progress import Progress
from stages.common.runner.job import Job
from stages.common.shards import shard_range
from stages.physics.images.displacement import Field
from stages.physics.images.source_images import Source, open_source
from stages.physics.images.table import Frame, load_frames
from stages.physics.images.table_checks import check_distinct
from stages.physics.maps.grid import LocalFrames
from stages.physics.maps.window import Window
from stages.project.config import Config
from stages.project.geometry import Geometry, check_directions, crop_geometry
from stages.project.inputs import Scene, check_places, check_sources, count_pairs, open_scene, scene_of
from stages.project.register import displacement_at, register, resemble, write_registration, write_resemblances
from stages.project.summary import Registered, Resemblance, Summary, summarise, write_shifts
from stages.project.writing import Layout, Pair, PairDatasets, Tally

PAIRS_EACH = 512  # in one shard
CROP_COLUMNS = ("longitude_deg", "latitude_deg", "row", "col", "image_index", "site", "tile", "split")


def work(crops: Path, output: Output, config: Config, progress: Progress) -> Summary:
    """See :func:`stages.project.run`."""
    with open_artefact(crops, CROPS) as file, open_scene(crops, file, config) as scene:
        frames = load_frames(file, crops)
        check_distinct(frames)
        size, part = int(file.attrs["crop_px"]), slice(*shard_range(len(file["row"]), config.shard))
        check_sources(crops, [frames[k] for k in sorted({int(k) for k in file["image_index"][part]})])
        check_places(crops, file, scene.elevation.shape)
        units = _units(crops, file, frames)
        with ArtefactWriter(
            output.file,
            PAIRS,
            {"pair": part.stop - part.start, "y": size, "x": size, "enu": 3, "frame": len(frames)},
            config=asdict(config),
            inputs=[crops, scene.path],
            seed=int(file.attrs["seed"]),
            attributes={"gsd_m": scene.grid.gsd, "body_radius_m": scene.grid.radius},
        ) as writer:
            summary = _project(writer, Crops(file, part, scene.elevation), scene, frames, units, config, progress)
            if output.shifts is not None:
                write_shifts(output.shifts, summary.registered)
            return summary


def in_parts(job: Job, crops: Path, config: Config) -> Summary:
    """The pairs from shards of the crops."""
    if config.scene:
        config = replace(config, scene=str(Path(config.scene).resolve()))
    pieces = job.shards("pairs", [crops], config, count_pairs(crops), PAIRS_EACH)
    whole = Output(job.output.file, overwrite=True)
    merge.run(pieces, whole, merge.Config(inputs=(crops, scene_of(crops, config))), progress=job.progress)
    return summarise(job.output.file)


@dataclass(frozen=True)
class Crops:
    """The crops of one shard. part : its rows of crops.h5; terrain : the scene's elevations, (H, W) m"""

    file: h5py.File
    part: slice
    terrain: Any

    def column(self, name: str) -> NDArray:
        """(n,) values of one variable."""
        return np.asarray(self.file[name][self.part])

    def elevation(self, k: int) -> NDArray[np.float32]:
        """(size, size) m. Crop by crop: an image may have more of them than fit into memory."""
        row, col = (int(self.file[name][self.part.start + k]) - self.size // 2 for name in ("row", "col"))
        return np.asarray(self.terrain[row : row + self.size, col : col + self.size])

    @property
    def size(self) -> int:
        """px, of a crop's side"""
        return int(self.file.attrs["crop_px"])


@dataclass(frozen=True)
class View:
    """One image and its m crops. rows, cols : (m,) of their middles; mean : (m,) m, their mean elevations; local :
    their frames; field : the displacement that registration takes off, None without registration
    """

    source: Source
    field: Field | None
    rows: NDArray
    cols: NDArray
    mean: NDArray[np.float64]
    local: LocalFrames
    geometry: Geometry


def _units(crops: Path, file: h5py.File, frames: list[Frame]) -> str:
    """Of the images of all crops: shards share them, and one of few crops may be empty."""
    units = {frames[int(k)].units for k in np.unique(file["image_index"][...])} or {"iof"}
    if len(units) > 1:
        raise InputError(f"{crops}: expected one kind of units, found both 'iof' and 'dn'; ingest them apart.")
    return units.pop()


def _project(
    writer: ArtefactWriter,
    crops: Crops,
    scene: Scene,
    frames: list[Frame],
    units: str,
    config: Config,
    progress: Progress,
) -> Summary:
    layout = Layout() if config.exact else Layout.of(frames, units, scene.heights, crops.size * scene.grid.gsd)
    # by the whole table, not this shard's images: all parts of one whole hold the same variables
    rays = any(f.camera for f in frames)
    datasets = PairDatasets(writer, "1" if units == "iof" else "dn", layout, rays, config.register is not None)
    tally, registered, resemblances = Tally(), list[Registered](), list[Resemblance]()
    image_index, rows, cols = (crops.column(name) for name in ("image_index", "row", "col"))
    total = len(image_index)
    for index in np.unique(image_index).tolist():
        frame, mine = frames[index], np.flatnonzero(image_index == index)
        # Even crops are centred on the corner shared by their four middle pixels.
        local = scene.grid.local_frames(rows[mine] - 0.5, cols[mine] - 0.5)
        mean = np.array([crops.elevation(k).mean(dtype=float) for k in mine.tolist()])
        radius = scene.grid.radius
        geometry = crop_geometry(local, mean, radius, frame.sun_position(), frame.camera_position(radius))
        check_directions(frame, geometry)
        with open_source(frame, scene.grid, scene.elevation, scene.heights) as source:
            field = None
            if config.register:
                progress(tally.pairs, total, f"registration ({frame.image_id})")
                registered.append(register(frame, index, source, crops.file, scene, config))
                field = registered[-1].field
            resemblances.append(resemble(frame, index, source, crops.file, scene, field))
            view = View(source, field, rows[mine], cols[mine], mean, local, geometry)
            for place, k in enumerate(mine.tolist()):
                if tally.pairs % 20 == 0:
                    progress(tally.pairs, total, f"pairs ({frame.image_id})")
                pair = _pair(view, place, crops.elevation(k), scene)
                datasets.put(k, pair, frame.image_id)
                tally.add(pair, frame)
    progress(total, total, "pairs")
    for name in CROP_COLUMNS:
        writer.write(name, crops.column(name))
    writer.write("image_id", [f.image_id for f in frames])
    writer.write("solar_distance_au", np.array([f.solar_distance_au for f in frames]))
    writer.write("wavelength_nm", np.array([f.wavelength_nm for f in frames]))
    if config.register:
        write_registration(writer, frames, registered)
    write_resemblances(writer, frames, resemblances)
    summary = tally.summary(crops.size, units)
    return replace(summary, registered=tuple(registered), resemblances=tuple(resemblances))


def _pair(view: View, place: int, heights: NDArray[np.float32], scene: Scene) -> Pair:
    """The image, the Sun, the camera and the horizon of the crop at ``place`` among those of one image."""
    grid, size = scene.grid, heights.shape[0]
    row, col = int(view.rows[place]), int(view.cols[place])
    corner = row - size // 2, col - size // 2
    pixels = view.source.read(*corner, size, size, view.field)
    sun, camera = view.geometry.sun[place], view.geometry.camera[place]
    if pixels.ortho is not None:
        # the line-scan camera's own place for this crop, not the one for the middle of its image
        centre = view.local.up[place] * (grid.radius + view.mean[place])
        camera = view.local.axes[place] @ (pixels.ortho.camera_position - centre)
    east, north, _ = sun
    angle = scene.horizon(Window(*corner, size, size), math.atan2(east, north) % (2 * math.pi))
    displacement = (0.0, 0.0)
    if view.field is not None:
        displacement = displacement_at(view.source, view.field, row - 0.5, col - 0.5, view.mean[place])
    return Pair(
        image=pixels.values,
        elevation=heights,
        valid=pixels.valid & np.isfinite(heights),
        horizon=angle,
        sun=sun,
        camera=camera,
        convergence_deg=float(view.local.convergence_deg[place]),
        displacement=displacement,
        ortho=pixels.ortho,
    )
