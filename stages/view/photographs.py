"""Measured photographs for a page: a few crops of pairs.h5 on the map, with their Sun and their camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import PAIRS, SPLITS, InputError, open_artefact, read_strings
from schemas.packing import read
from stages.common.arrays import Floats32
from stages.pairs.reader import read_reference
from stages.physics.maps.grid import Grid
from stages.physics.maps.projections import near_longitude
from stages.view.frames import Frames
from stages.view.layers import block_mean

SAME_GSD = 0.01  # relative


@dataclass(frozen=True)
class Photograph:
    """A crop of a measured image, with its Sun and its camera.

    image : (h, w) float32, NaN where invalid; row, col of its first pixel on the page's map
    sun_azimuth_deg, sun_elevation_deg : over the map's middle, from true north
    camera : (3,), m, from the middle's point on the sphere along the middle's axes
    """

    title: str
    image: Floats32
    unit: str
    row: int
    col: int
    sun_azimuth_deg: float
    sun_elevation_deg: float
    camera: NDArray[np.float64]


def read_photographs(path: Path, grid: Grid, factor: int, frames: Frames, count: int) -> list[Photograph]:
    """At most ``count`` crops that lie on the map, of as many images as there are, test crops first. Raises LunargrError.

    grid : of the page; factor : pixels of the file along each side of one of its pixels
    """
    with open_artefact(path, PAIRS) as file:
        map_gsd, crop_gsd = grid.gsd / factor, float(file.attrs["gsd_m"])
        if abs(crop_gsd - map_gsd) > SAME_GSD * map_gsd:
            raise InputError(
                f"{path}: expected crops at the map's {map_gsd:g} m per pixel, found {crop_gsd:g} m; give the pairs.h5 of this map's scene."
            )
        size = file["image"].shape[1:]
        rows, cols = grid.rowcol_of_lonlat(file["longitude_deg"][...], file["latitude_deg"][...])
        # a crop's centre is a corner of pixels; corners of the file's pixels count from the map's outer corner
        tops = np.rint((rows + 0.5) * factor - size[0] / 2).astype(int)
        lefts = np.rint((cols + 0.5) * factor - size[1] / 2).astype(int)
        whole = (tops >= 0) & (lefts >= 0)
        whole &= (tops + size[0] <= grid.height * factor) & (lefts + size[1] <= grid.width * factor)
        if not whole.any():
            raise InputError(f"{path}: expected crops on the map, found none; give the pairs.h5 of this map's scene.")
        return [
            _photograph(file, k, (int(tops[k]), int(lefts[k])), grid, factor, frames)
            for k in _choose(file, np.flatnonzero(whole), count)
        ]


def _choose(file: h5py.File, candidates: NDArray[np.int_], count: int) -> list[int]:
    """Crops from image after image; in each the test split first, then what lies nearest to the middle of the map."""
    image = file["image_index"][...][candidates]
    test = file["split"][...][candidates] == dict(SPLITS)["test"] if "split" in file else np.zeros(len(image), bool)
    lon, lat = file["longitude_deg"][...][candidates], file["latitude_deg"][...][candidates]
    lon = near_longitude(lon, float(lon[0]))
    away = np.hypot((lon - lon.mean()) * math.cos(math.radians(lat.mean())), lat - lat.mean())
    order = np.lexsort((away, ~test, image))
    first = [order[np.flatnonzero(image[order] == i)[0]] for i in np.unique(image)]
    rest = [k for k in order if k not in set(first)]
    chosen: list[int] = []
    for k in [*first, *rest]:
        if len(chosen) == count:
            break
        if file["valid"][candidates[k]].mean() > 0.9:
            chosen.append(int(candidates[k]))
    return chosen


def _photograph(
    file: h5py.File, k: int, corner: tuple[int, int], grid: Grid, factor: int, frames: Frames
) -> Photograph:
    image = np.where(file["valid"][k] == 1, read(file["image"], k), np.nan).astype(np.float32)
    top, left = (-(-c // factor) for c in corner)
    image = block_mean(image[top * factor - corner[0] :, left * factor - corner[1] :], factor)
    middle = (top + (image.shape[0] - 1) / 2, left + (image.shape[1] - 1) / 2)
    axes = grid.local_frames(*middle).axes[0] @ frames.middle.T  # of the crop, in the axes of the map's middle
    height = float(np.nanmean(read(file["elevation"], k)) + read_reference(file)[k])
    base = axes[2] * (grid.radius + height) - np.array([0.0, 0.0, grid.radius])
    east, north, up = file["sun_direction_enu"][k] @ axes
    azimuth = math.degrees(math.atan2(east, north)) - frames.convergence_deg
    name = read_strings(file, "image_id")[int(file["image_index"][k])]
    unit = str(file["image"].attrs.get("units", "1"))
    return Photograph(
        title=name,
        image=image,
        unit=unit,
        row=top,
        col=left,
        sun_azimuth_deg=azimuth % 360,
        sun_elevation_deg=math.degrees(math.asin(max(-1.0, min(1.0, float(up))))),
        camera=base + file["camera_position_enu"][k] @ axes,
    )
