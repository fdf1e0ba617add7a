"""What project reads: the crops, the scene that they come from, its far terrain, and the images."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas import CROPS, SCENE, ArtefactError, InputError, open_artefact
from schemas.files.user_files import check_file
from schemas.provenance import file_state, sha256
from stages.physics.horizon.scene import Overview, SceneTerrain
from stages.physics.images.table import Frame
from stages.physics.maps.grid import Grid, read_grid
from stages.project.config import Config


@dataclass(frozen=True)
class Scene(SceneTerrain):
    """An open scene."""

    path: Path


@contextmanager
def open_scene(crops: Path, file: h5py.File, config: Config) -> Iterator[Scene]:
    """The scene of crops. Raises ArtefactError where it is gone or another one."""
    path = find_scene(crops, file, config)
    if sha256(path) != file.attrs["scene_sha256"]:
        raise ArtefactError(f"{path}: not the scene that {crops} was sampled from; run 'lunargr sample' again.")
    with open_artefact(path, SCENE) as scene:
        terrain = _terrain(path, scene["elevation"], read_grid(scene, path))
        yield Scene(**vars(terrain), path=path)


def check_sources(crops: Path, frames: list[Frame]) -> None:
    """Refuse images and cameras that are not those that the scene's masks were made from. Raises InputError."""
    for frame in frames:
        for path, known in ((frame.path, frame.sha256), (frame.camera, frame.camera_sha256)):
            if path is None or not known:
                continue
            check_file(path, f"a file of the image '{frame.image_id}' of {crops}")
            if sha256(path) != known:
                raise InputError(
                    f"{path}: expected the file of image '{frame.image_id}' that {crops} was made with, found another content; "
                    "bring it back, or run 'lunargr ingest' and 'lunargr sample' again."
                )


def check_places(crops: Path, file: h5py.File, shape: tuple[int, int]) -> None:
    """Refuse crops that are not of an even size, and on the scene. Raises ArtefactError."""
    size = int(file.attrs["crop_px"])
    half = size // 2
    if size % 2:
        raise ArtefactError(
            f"{crops}: root attribute 'crop_px': expected an even size, found {size}; run 'lunargr sample' again."
        )
    for name, edge in zip(("row", "col"), shape, strict=True):
        centre = file[name][...].astype(np.int64)
        if len(centre) and (centre.min() < half or centre.max() > edge - half):
            raise ArtefactError(
                f"{crops}:/{name}: expected crops that lie on the scene, {half} .. {edge - half}, "
                f"found {centre.min()} .. {centre.max()}; run 'lunargr sample' again."
            )


def find_scene(crops: Path, file: h5py.File, config: Config) -> Path:
    """The scene that an open crops.h5 was sampled from. Raises ArtefactError where it is gone."""
    scene = Path(config.scene) if config.scene else crops.resolve().parent / str(file.attrs["scene"])
    if not scene.exists():
        raise ArtefactError(f"{scene}: no such file; {crops} was sampled from it. Name its new place with `scene`.")
    return scene


def scene_of(crops: Path, config: Config) -> Path:
    """The scene that crops were sampled from. Raises ArtefactError where it is gone."""
    with open_artefact(crops, CROPS) as file:
        return find_scene(crops, file, config)


def count_pairs(crops: Path) -> int:
    """Crops in a file."""
    with open_artefact(crops, CROPS) as file:
        return int(file["row"].shape[0])


_overviews: dict[tuple[Any, ...], Overview] = {}


def _terrain(scene: Path, elevation: h5py.Dataset, grid: Grid) -> SceneTerrain:
    """The far terrain is made of the whole DEM once, for all parts that one process works on."""
    key = (os.path.realpath(scene), *file_state(scene))
    if key not in _overviews:
        _overviews.clear()
        _overviews[key] = SceneTerrain.of(elevation, grid).overview
    return SceneTerrain(elevation, grid, _overviews[key])
