"""project: orthorectify the images onto the crops and add Sun, camera and horizon: `pairs.h5`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import CROPS, PAIRS, SCENE, ArtefactError, ArtefactWriter, GeometryError, InputError, open_artefact
from schemas.hdf5 import sha256
from stages.physics import rasters
from stages.physics.frames import Frame, load_frames
from stages.physics.grid import LocalFrames, read_grid
from stages.physics.scene_horizon import horizon_in_scene, make_overview

Progress = Callable[[int, int, str], None]

SEARCH_BELOW_SUN = math.radians(5)  # terrain surely lower than this casts no shadow even with a wrong Sun
OVERVIEW_PX = 2048  # the far terrain is kept in memory at no more than this many pixels a side


@dataclass(frozen=True)
class Config:
    """scene : overrides the scene that crops.h5 names."""

    scene: str | None = None
    shard: tuple[int, int] = (0, 1)


@dataclass(frozen=True)
class Geometry:
    """Sun and camera of n crops in their own frames: unit vectors and metres, (n, 3); see Grid.local_frames."""

    sun: NDArray[np.float64]
    camera: NDArray[np.float64]
    convergence_deg: NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """What project wrote, for the line at the end."""

    pairs: int
    valid_share: float
    incidence_deg: tuple[float, float]
    emission_deg: tuple[float, float]
    shadowed_share: float


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
    """Write ``pairs.h5``. Raises ArtefactError, InputError or GeometryError; then nothing is written."""
    with open_artefact(crops, CROPS) as file:
        scene = Path(config.scene) if config.scene else crops.resolve().parent / str(file.attrs["scene"])
        if not scene.exists():
            raise ArtefactError(f"{scene}: no such file; {crops} was sampled from it. Name its new place with --scene.")
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
    overview = make_overview(scene_file["elevation"], max(1, math.ceil(max(grid.height, grid.width) / OVERVIEW_PX)))
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
        images = writer.dataset("image", unit=unit)
        names = ("elevation", "valid", "sun_horizon_deg", "sun_direction_enu", "camera_position_enu", "convergence_deg")
        elevation, valid, horizon, sun_out, camera_out, convergence = (writer.dataset(n) for n in names)
        done = 0
        for index in sorted({int(k) for k in image_index}):
            frame = frames[index]
            mine = np.flatnonzero(image_index == index)
            heights = np.stack([file["elevation"][part.start + k] for k in mine])
            # Even crops are centred on the corner shared by their four middle pixels.
            local = grid.local_frames(row[mine] - 0.5, col[mine] - 0.5)
            geometry = crop_geometry(
                local,
                heights.mean(axis=(1, 2), dtype=float),
                grid.radius,
                frame.sun_position(),
                frame.camera_position(grid.radius),
            )
            _check_directions(frame, geometry)
            with rasters.open_raster(frame.path, f"the image '{frame.image_id}'") as image:
                resampling, _ = rasters.choose_resampling(
                    image, grid.window(int(row[mine[0]]), int(col[mine[0]]), 1, 1)
                )
                for place, k in enumerate(mine):
                    if progress and done % 20 == 0:
                        progress(done, pairs, f"pairs ({frame.image_id})")
                    done += 1
                    corner = int(row[k]) - half, int(col[k]) - half
                    values, seen = rasters.warp(image, grid.window(*corner, size, size), resampling)
                    seen &= np.isfinite(heights[place])
                    east, north, up = geometry.sun[place]
                    angle = horizon_in_scene(
                        scene_file["elevation"],
                        overview,
                        *corner,
                        size,
                        size,
                        grid.gsd,
                        math.atan2(east, north) % (2 * math.pi),
                        sun_elevation=math.asin(up) - SEARCH_BELOW_SUN,
                        body_radius=grid.radius,
                    )
                    images[k], valid[k], elevation[k] = np.where(seen, values, np.nan), seen, heights[place]
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
    return Summary(
        pairs,
        valid_pixels / max(1, pairs * size * size),
        (min(incidence, default=math.nan), max(incidence, default=math.nan)),
        (min(emission, default=math.nan), max(emission, default=math.nan)),
        shadowed / max(1, valid_pixels),
    )


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
