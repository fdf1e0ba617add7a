"""project: orthorectify the images onto the crops and add Sun, camera and horizon: `pairs.h5`."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import (
    CROPS,
    PAIRS,
    SCENE,
    ArtefactError,
    ArtefactWriter,
    ConfigError,
    GeometryError,
    InputError,
    open_artefact,
)
from schemas.provenance import sha256
from schemas.reading import unpack
from stages.physics.horizon.scene import Overview, horizon_in_scene, make_overview
from stages.physics.images.orthorectify import Ortho
from stages.physics.images.register_frame import choose_regions, register_frame
from stages.physics.images.registration import Field, Shift
from stages.physics.images.source_images import Source, open_source
from stages.physics.images.table import Frame, load_frames
from stages.physics.maps import rasters
from stages.physics.maps.grid import Grid, LocalFrames, read_grid

Progress = Callable[[int, int, str], None]

# Digits after the point, which pairs.h5 keeps; docs/scaling.md says what they do to a rendering.
IOF_DECIMALS, COUNT_DECIMALS, HORIZON_DECIMALS = 5, 1, 1
RAY_DECIMALS = {"detector_line": 2, "detector_sample": 2, "emission_deg": 2, "phase_deg": 3}
OVERVIEW_PX = 2048  # the far terrain is kept in memory at no more than this many pixels a side


@dataclass(frozen=True)
class Config:
    """scene : overrides the scene that crops.h5 names; register : None, 'shift' or 'affine'; max_shift : px searched;
    exact : keep float32 as it is instead of the digits that matter."""

    scene: str | None = None
    shard: tuple[int, int] = (0, 1)
    register: str | None = None
    max_shift: float = 8.0
    exact: bool = False


@dataclass(frozen=True)
class Geometry:
    """Sun and camera of n crops in their own frames: unit vectors and metres, (n, 3); see Grid.local_frames."""

    sun: NDArray[np.float64]
    camera: NDArray[np.float64]
    convergence_deg: NDArray[np.float64]


@dataclass(frozen=True)
class Registered:
    """How one image lay against its rendering: the displacement that was taken off, and each region's own answer."""

    image_id: str
    field: Field
    regions: tuple[tuple[float, float, Shift], ...]  # row and column of the middle, and the shift there


@dataclass(frozen=True)
class Summary:
    """What project wrote, for the line at the end."""

    pairs: int
    valid_share: float
    incidence_deg: tuple[float, float]
    emission_deg: tuple[float, float]
    shadowed_share: float
    registered: tuple[Registered, ...] = ()


def crop_geometry(
    local: LocalFrames, elevation: NDArray[np.float64], radius: float, sun_position: NDArray, camera_position: NDArray
) -> Geometry:
    """Directions from crop centres at their mean ``elevation`` (n,) to Sun and camera (body-fixed, m)."""
    centre = local.up * (radius + elevation)[:, None]
    to_sun = sun_position - centre
    to_sun /= np.linalg.norm(to_sun, axis=1, keepdims=True)
    sun = np.einsum("nij,nj->ni", local.axes, to_sun)
    camera = np.einsum("nij,nj->ni", local.axes, camera_position - centre)
    return Geometry(sun, camera, local.convergence_deg)


def run(
    crops: Path, output: Path, config: Config, overwrite: bool = False, progress: Progress | None = None
) -> Summary:
    """Write ``pairs.h5``. Raises ArtefactError, ConfigError, InputError or GeometryError; then nothing is written."""
    if config.register not in (None, "shift", "affine"):
        raise ConfigError(f"--register: expected 'shift' or 'affine', found '{config.register}'.")
    if not 1.0 <= config.max_shift <= 32.0:
        raise ConfigError(f"--max-shift: expected 1 to 32 px, found {config.max_shift:g}.")
    with open_artefact(crops, CROPS) as file:
        scene = _scene_of(crops, file, config)
        if sha256(scene) != file.attrs["scene_sha256"]:
            raise ArtefactError(f"{scene}: not the scene that {crops} was sampled from; run 'lunargr sample' again.")
        frames = load_frames(file, crops)
        total = file["row"].shape[0]
        first, last = (total * k // config.shard[1] for k in (config.shard[0], config.shard[0] + 1))
        used = sorted({int(k) for k in file["image_index"][first:last]})
        units = {frames[k].units for k in used} or {"iof"}
        if len(units) > 1:
            raise InputError(f"{crops}: expected one kind of units, found both 'iof' and 'dn'; ingest them apart.")
        with open_artefact(scene, SCENE) as scene_file:
            return _project(
                crops,
                scene,
                output,
                file,
                scene_file,
                frames,
                slice(first, last),
                units.pop(),
                config,
                overwrite,
                progress,
            )


def _project(
    crops: Path,
    scene: Path,
    output: Path,
    file: h5py.File,
    scene_file: h5py.File,
    frames: list[Frame],
    part: slice,
    units: str,
    config: Config,
    overwrite: bool,
    progress: Progress | None,
) -> Summary:
    grid = read_grid(scene_file, scene)
    pairs, size = part.stop - part.start, file["elevation"].shape[1]
    half = size // 2
    row, col, image_index = (file[k][part] for k in ("row", "col", "image_index"))
    overview = _overview_of(scene, scene_file["elevation"])
    attributes = {"gsd_m": grid.gsd, "body_radius_m": grid.radius}
    sizes = {"pair": pairs, "y": size, "x": size, "enu": 3, "frame": len(frames)}
    valid_pixels, shadowed, incidence, emission = 0, 0, [], []
    with ArtefactWriter(
        output,
        PAIRS,
        sizes,
        config=asdict(config),
        inputs=[crops, scene],
        seed=int(file.attrs["seed"]),
        attributes=attributes,
        overwrite=overwrite,
    ) as writer:
        unit = "1" if units == "iof" else "dn"
        kept = {} if config.exact else _decimals(frames, units, grid.gsd)
        images = writer.dataset("image", unit=unit, decimals=kept.get("image"))
        elevation = writer.dataset("elevation", decimals=kept.get("elevation"))
        horizon = writer.dataset("sun_horizon_deg", decimals=kept.get("sun_horizon_deg"))
        names = ("valid", "sun_direction_enu", "camera_position_enu", "convergence_deg")
        valid, sun_out, camera_out, convergence = (writer.dataset(n) for n in names)
        chosen = sorted({int(k) for k in image_index})
        # of the whole table, not of this shard's images: the parts of one whole hold the same variables
        rays = []
        if any(f.camera for f in frames):
            rays = [writer.dataset(name, decimals=kept.get(name)) for name in RAY_DECIMALS]
        known = overview_extremes(scene_file["elevation"], overview)
        registered: list[Registered] = []
        done = 0
        for index in chosen:
            frame = frames[index]
            mine = np.flatnonzero(image_index == index)
            # Even crops are centred on the corner shared by their four middle pixels.
            local = grid.local_frames(row[mine] - 0.5, col[mine] - 0.5)
            # crop by crop, and read again below: an image may have more crops than fit into memory
            mean = np.array([file["elevation"][part.start + k].mean(dtype=float) for k in mine])
            geometry = crop_geometry(local, mean, grid.radius, frame.sun_position(), frame.camera_position(grid.radius))
            _check_directions(frame, geometry)
            with open_source(frame, grid, scene_file["elevation"], known) as source:
                field = None
                if config.register:
                    if progress:
                        progress(done, pairs, f"registration ({frame.image_id})")
                    registered.append(_register(frame, index, source, file, scene_file, overview, grid, config))
                    field = registered[-1].field
                for place, k in enumerate(mine):
                    if progress and done % 20 == 0:
                        progress(done, pairs, f"pairs ({frame.image_id})")
                    done += 1
                    corner = int(row[k]) - half, int(col[k]) - half
                    pixels = source.read(*corner, size, size, field)
                    heights = file["elevation"][part.start + k]
                    seen = pixels.valid & np.isfinite(heights)
                    if pixels.ortho is not None:
                        # the line-scan camera's own place for this crop, not the one for the middle of its image
                        centre = local.up[place] * (grid.radius + mean[place])
                        geometry.camera[place] = local.axes[place] @ (pixels.ortho.camera_position - centre)
                        _write_rays(rays, int(k), pixels.ortho)
                    east, north, up = geometry.sun[place]
                    angle = horizon_in_scene(
                        scene_file["elevation"],
                        overview,
                        *corner,
                        size,
                        size,
                        grid.gsd,
                        math.atan2(east, north) % (2 * math.pi),
                        body_radius=grid.radius,
                    )
                    images[k], valid[k], elevation[k] = np.where(seen, pixels.values, np.nan), seen, heights
                    horizon[k] = np.degrees(angle)
                    sun_out[k], camera_out[k] = geometry.sun[place], geometry.camera[place]
                    convergence[k] = geometry.convergence_deg[place]
                    valid_pixels += int(seen.sum())
                    shadowed += int((seen & (angle > math.asin(up))).sum())
                    incidence.append(math.degrees(math.acos(up)))
                    emission.append(
                        math.degrees(math.acos(geometry.camera[place][2] / np.linalg.norm(geometry.camera[place])))
                    )
        if progress:
            progress(pairs, pairs, "pairs")
        for name in ("longitude_deg", "latitude_deg", "row", "col", "image_index", "site", "tile", "split"):
            writer.write(name, file[name][part])
        writer.write("image_id", [f.image_id for f in frames])
        writer.write("solar_distance_au", np.array([f.solar_distance_au for f in frames]))
        if config.register:
            _write_shifts(writer, frames, registered)
    return Summary(
        pairs,
        valid_pixels / max(1, pairs * size * size),
        (min(incidence, default=math.nan), max(incidence, default=math.nan)),
        (min(emission, default=math.nan), max(emission, default=math.nan)),
        shadowed / max(1, valid_pixels),
        tuple(registered),
    )


def _scene_of(crops: Path, file: h5py.File, config: Config) -> Path:
    scene = Path(config.scene) if config.scene else crops.resolve().parent / str(file.attrs["scene"])
    if not scene.exists():
        raise ArtefactError(f"{scene}: no such file; {crops} was sampled from it. Name its new place with --scene.")
    return scene


def scene_of(crops: Path, config: Config) -> Path:
    """The scene that crops were sampled from. Raises ArtefactError where it is gone."""
    with open_artefact(crops, CROPS) as file:
        return _scene_of(crops, file, config)


def count_pairs(crops: Path) -> int:
    """Crops in a file."""
    with open_artefact(crops, CROPS) as file:
        return int(file["row"].shape[0])


def source_files(crops: Path) -> list[Path]:
    """The images and camera models that crops are taken from."""
    with open_artefact(crops, CROPS) as file:
        frames = load_frames(file, crops)
    return [p for f in frames for p in (f.path, f.camera) if p is not None]


def summarise(pairs: Path) -> Summary:
    """What pairs hold, for the line at the end: of a file that was put together from parts."""
    with open_artefact(pairs, PAIRS) as file:
        sun, camera = file["sun_direction_enu"][...], file["camera_position_enu"][...]
        seen = shadowed = total = 0
        for k in range(file["valid"].shape[0]):
            valid = file["valid"][k].astype(bool)
            angle = unpack(file["sun_horizon_deg"], file["sun_horizon_deg"][k]).astype(np.float64)
            above = np.radians(angle) > math.asin(sun[k, 2])
            seen, shadowed, total = seen + int(valid.sum()), shadowed + int((valid & above).sum()), total + valid.size
    incidence = np.degrees(np.arccos(sun[:, 2]))
    emission = np.degrees(np.arccos(camera[:, 2] / np.linalg.norm(camera, axis=1)))

    def extremes(angles: NDArray[np.float64]) -> tuple[float, float]:
        return (float(angles.min()), float(angles.max())) if len(angles) else (math.nan, math.nan)

    return Summary(len(sun), seen / max(1, total), extremes(incidence), extremes(emission), shadowed / max(1, seen))


_overviews: dict[tuple[Any, ...], Overview] = {}


def _overview_of(scene: Path, elevation: h5py.Dataset) -> Overview:
    """The far terrain, which takes a look at the whole DEM: the parts that one process works on share it."""
    state = os.stat(scene)
    key = (os.path.realpath(scene), state.st_size, state.st_mtime_ns)
    if key not in _overviews:
        _overviews.clear()
        _overviews[key] = make_overview(elevation, max(1, math.ceil(max(elevation.shape) / OVERVIEW_PX)))
    return _overviews[key]


def overview_extremes(elevation: h5py.Dataset, overview: Overview) -> tuple[float, float]:
    """Least and largest elevation of a scene, m: the largest is exact, the least that of block means less their relief."""
    cells = overview.cells[np.isfinite(overview.cells)]
    low = float(cells.min()) if cells.size else 0.0
    return low - 0.5 * max(0.0, overview.highest - low), overview.highest


def _register(
    frame: Frame,
    index: int,
    source: Source,
    crops: h5py.File,
    scene: h5py.File,
    overview: Overview,
    grid: Grid,
    config: Config,
) -> Registered:
    """Register one image by regions about all of its crops, whatever the shard: every shard takes off the same."""
    all_of_it = crops["image_index"][...] == index
    regions = choose_regions(crops["row"][...][all_of_it], crops["col"][...][all_of_it], grid)
    field, shifts = register_frame(
        frame, source, scene["elevation"], overview, grid, regions, str(config.register), config.max_shift
    )
    places = [(r + (h - 1) / 2, c + (w - 1) / 2) for r, c, h, w in regions]
    return Registered(frame.image_id, field, tuple((r, c, s) for (r, c), s in zip(places, shifts, strict=True)))


def _put(target: h5py.Dataset, k: int, values: NDArray) -> None:
    """One pair's values, unknown ones as the dataset writes them."""
    known = np.isfinite(values)
    target[k] = values if known.all() else np.where(known, values, target.fillvalue)


def _decimals(frames: list[Frame], units: str, gsd: float) -> dict[str, int | None]:
    """Digits after the point: elevations in steps of at most gsd / 400, images of 1e-5 of I/F or a tenth of a count.

    Counts that are not whole numbers in the images keep all their digits: nobody knows how large they are.
    """
    image: int | None = IOF_DECIMALS if units == "iof" else COUNT_DECIMALS
    if units == "dn":
        for frame in frames:
            with contextlib.suppress(InputError), rasters.open_raster(frame.path) as source:
                if np.dtype(source.dtypes[0]).kind == "f" or source.scales[0] < 1:
                    image = None
    elevation = max(0, math.ceil(math.log10(400 / gsd)))
    return {"image": image, "elevation": elevation, "sun_horizon_deg": HORIZON_DECIMALS, **RAY_DECIMALS}


def _write_rays(rays: list[h5py.Dataset], k: int, ortho: Ortho) -> None:
    line, sample, emission, phase = rays
    _put(line, k, ortho.detector_line)
    _put(sample, k, ortho.detector_sample)
    _put(emission, k, np.degrees(ortho.emission))
    _put(phase, k, np.degrees(ortho.phase))


def _write_shifts(writer: ArtefactWriter, frames: list[Frame], registered: list[Registered]) -> None:
    found = {r.image_id: r.field for r in registered}
    columns = np.full((4, len(frames)), np.nan)
    for k, frame in enumerate(frames):
        field = found.get(frame.image_id)
        if field is not None and field.accepted:
            columns[:, k] = (*field.coefficients[:, 0], field.sigma, field.correlation)
    for name, values in zip(
        ("shift_col_px", "shift_row_px", "shift_sigma_px", "shift_correlation"), columns, strict=True
    ):
        writer.write(name, values)


def _check_directions(frame: Frame, geometry: Geometry) -> None:
    """Sun and camera must stand above every crop's horizon plane. Raises GeometryError."""
    if geometry.sun[:, 2].min() <= 0:
        raise GeometryError(
            f"image '{frame.image_id}': the Sun is below the horizon at {int((geometry.sun[:, 2] <= 0).sum())} crop centres; "
            "check its sub-solar point (degrees east)."
        )
    if geometry.camera[:, 2].min() <= 0:
        raise GeometryError(
            f"image '{frame.image_id}': the camera is below the horizon at {int((geometry.camera[:, 2] <= 0).sum())} crop centres; "
            "check spacecraft_longitude_deg, spacecraft_latitude_deg and spacecraft_altitude_m."
        )
