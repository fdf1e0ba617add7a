"""Write a case as pairs.h5, the file that `lunargr project` makes of real data; layout from the program's documentation."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike

from .fields import Array
from .geometry import MOON
from .scene import Scene

PIXELS = ("pair", "y", "x")
FILL = np.float32(9.96921e36)  # netCDF's own
NAN = np.float64("nan")


def write_pairs(
    path: Path,
    scene: Scene,
    images: Array,
    dem: Array,
    horizons: Array,
    sun: Array,
    samples: ArrayLike,
    lines: ArrayLike,
) -> None:
    """Images, horizons (degrees), detector samples and lines (pairs, size, size); dem (grid, grid), m; sun (pairs, 3)."""
    part = path.with_suffix(path.suffix + ".part")
    n, count = scene.size, len(scene.pairs)
    site = np.array([site for site, _ in scene.pairs])
    crops = scene.sites.crops(dem)
    with h5py.File(part, "w", track_order=True) as file:
        _head(file, scene.ground.gsd)
        put = _Putter(file, {"pair": count, "y": n, "x": n, "enu": 3, "frame": scene.sites.images})
        put.pixels("elevation", crops[site], "m", "height above the reference sphere")
        put.pixels(
            "sun_horizon_deg", horizons, "degree",
            "elevation of the terrain horizon in the Sun's azimuth, from the whole DEM",
        )  # fmt: skip
        put.pixels("image", images, "1", "orthorectified image: I/F where units = 1")
        flags = {"flag_values": np.array([0, 1], "u1"), "flag_meanings": "invalid valid"}
        about = {"units": "1", "long_name": "1 = both DEM and image are valid", **flags}
        put("valid", np.ones((count, n, n)), PIXELS, "u1", about, chunks=(1, n, n), compression="gzip")
        put.pixels("detector_sample", samples, "px", "detector sample where the pixel was seen")
        put.pixels("detector_line", lines, "px", "detector line where the pixel was seen")
        put.vectors(
            "sun_direction_enu", sun, "1",
            "unit vector towards the Sun at the crop centre, along the crop's columns, rows (north) and up",
        )  # fmt: skip
        put.vectors(
            "camera_position_enu", scene.geometry.camera, "m",
            "camera position from the crop centre at the crop's mean elevation, same axes",
        )  # fmt: skip
        for name, values, text in (
            ("convergence_deg", np.zeros(count), "true north at the crop centre, clockwise from the crop's up-column direction"),
            ("longitude_deg", scene.geometry.longitude, "east longitude of the crop centre"),
            ("latitude_deg", scene.geometry.latitude, "planetocentric latitude of the crop centre"),
        ):  # fmt: skip
            put(name, values, ("pair",), "f8", {"units": "degree", "_FillValue": NAN, "long_name": text})
        for name, values, text in (
            (
                "row", scene.sites.row[site],
                "row of the crop centre on the scene grid: the crop spans row - size/2 .. row + size/2 - 1",
            ),
            ("col", scene.sites.col[site], "column of the crop centre on the scene grid"),
            ("image_index", np.array([image for _, image in scene.pairs]), "index into the frame dimension"),
            ("site", site, "pairs with the same site show the same ground, pixel for pixel"),
            ("tile", site, "ground tile of the geographic split"),
        ):  # fmt: skip
            put(name, values, ("pair",), "i4", {"units": "1", "long_name": text})
        flags = {"flag_values": np.array([0, 1, 2], "u1"), "flag_meanings": "train validation test"}
        about = {"units": "1", "long_name": "which part of the geographic split", **flags}
        put("split", scene.sites.split[site], ("pair",), "u1", about)
        names = [f"L{image:04d}" for image in range(scene.sites.images)]
        data = file.create_dataset("image_id", data=names, dtype=h5py.string_dtype())
        data.dims[0].attach_scale(put.scales["frame"])
        data.attrs["long_name"] = "name of the source image"
        about = {"units": "au", "_FillValue": NAN, "long_name": "distance of the Sun"}
        put("solar_distance_au", scene.sky.distance, ("frame",), "f8", about)
    os.replace(part, path)


def _head(file: h5py.File, gsd: float) -> None:
    file.attrs["Conventions"] = "CF-1.11"
    file.attrs["title"] = "DEM crops and the images orthorectified onto them, with Sun, camera and horizon"
    file.attrs["lunargr_schema"] = "pairs"
    file.attrs["schema_version"] = np.int32(1)
    file.attrs["lunargr_version"] = "0.1.0"
    file.attrs["history"] = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} laboratory"
    file.attrs["command"] = "laboratory"
    file.attrs["folder"] = ""
    file.attrs["config"] = "{}"
    file.attrs["inputs"] = "[]"
    file.attrs["seed"] = np.int64(0)
    file.attrs["provenance"] = "{}"
    file.attrs["gsd_m"] = np.float64(gsd)
    file.attrs["body_radius_m"] = np.float64(MOON)


class _Putter:
    """Writes data sets on the netCDF dimensions of a file, which it makes."""

    def __init__(self, file: h5py.File, dimensions: dict[str, int]):
        self.file = file
        self.scales = {}
        for number, (name, length) in enumerate(dimensions.items()):
            scale = file.create_dataset(name, shape=(length,), dtype=">f4")
            scale.make_scale(f"This is a netCDF dimension but not a netCDF variable. {length:9d}")
            scale.attrs["_Netcdf4Dimid"] = np.int32(number)
            self.scales[name] = scale

    def __call__(
        self, name: str, values: ArrayLike, dimensions: tuple[str, ...], kind: str, attributes: dict, **storage
    ) -> None:
        data = self.file.create_dataset(name, data=np.asarray(values, dtype=kind), track_order=True, **storage)
        for axis, dimension in enumerate(dimensions):
            data.dims[axis].attach_scale(self.scales[dimension])
        for key, value in attributes.items():
            data.attrs[key] = value

    def pixels(self, name: str, values: ArrayLike, units: str, text: str) -> None:
        edge = min(64, len(self.scales["x"]))
        about = {"units": units, "_FillValue": FILL, "long_name": text}
        self(name, values, PIXELS, "f4", about, chunks=(1, edge, edge))

    def vectors(self, name: str, values: ArrayLike, units: str, text: str) -> None:
        self(name, values, ("pair", "enu"), "f8", {"units": units, "_FillValue": NAN, "long_name": text})
