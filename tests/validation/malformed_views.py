"""Trajectories, ISD cameras, parts of a stage and maps of other conventions, with one thing wrong in each."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import small_scene
from malformed import Case
from malformed_inputs import INGEST, _column, _cut, raster, text
from push_frame import isd

TRAJECTORY = [
    "render", "svbrdf.h5", "--trajectory", "views.csv", "--size", "8,8", "--sun-azimuth", "90", "--sun-elevation", "30",
    "-o", "out.exr",
]  # fmt: skip
MERGE = ["merge", "part_1.h5", "part_2.h5", "-o", "out.h5"]
CONVERT = ["convert", "maps.tif", "--from", "lunargr:M2", "--to", "g2r:polynomial_3p_cst", "-o", "out.tif"]
GOOD_ROW = {
    "view_id": "a", "longitude_deg": small_scene.LON, "latitude_deg": small_scene.LAT, "altitude_m": 3000, "fov_deg": 10,
}  # fmt: skip


def view_cases() -> Iterator[Case]:
    yield from _trajectories()
    yield from _isds()
    yield from _parts()
    yield from _conversions()


def write_views(folder: Path) -> None:
    """What the cases make bad: a trajectory, an ISD, two shards of the pairs, a map in another program's convention."""
    from stages import project
    from stages.physics.photometry import get_model

    _write_row(folder / "views.csv", GOOD_ROW)
    (folder / "isd.json").write_text(json.dumps(isd()))
    for number in (0, 1):
        project.run(folder / "crops.h5", folder / f"part_{number + 1}.h5", project.Config(shard=(number, 2)))
    names = [p.name for p in get_model("M2").parameters]
    import rasterio

    with rasterio.open(folder / "dem.tif") as source:
        values, profile = source.read(1), source.profile
    profile |= {"count": len(names), "nodata": float("nan"), "dtype": "float32"}
    with rasterio.open(folder / "maps.tif", "w", **profile) as out:
        for band, name in enumerate(names, start=1):
            out.write((values * 0 + 0.1).astype("float32"), band)
            out.set_band_description(band, name)


def _write_row(path: Path, row: dict[str, Any]) -> None:
    path.write_text(",".join(row) + "\n" + ",".join(str(v) for v in row.values()) + "\n")


def _trajectories() -> Iterator[Case]:
    def row(**change: Any) -> Callable[[Path], None]:
        return lambda folder: _write_row(folder / "views.csv", GOOD_ROW | change)

    numbers = (
        "longitude_deg", "latitude_deg", "altitude_m", "look_longitude_deg", "look_latitude_deg", "look_altitude_m", "qw",
        "roll_deg", "fov_deg", "subsolar_longitude_deg", "subsolar_latitude_deg", "sun_azimuth_deg", "sun_elevation_deg",
        "solar_distance_au",
    )  # fmt: skip
    for name in numbers:
        for value in ("text", "nan", "inf", "1e999", "\x1b[31m5"):
            yield Case(f"trajectory: {name} = {value!r}", TRAJECTORY, "views.csv", row(**{name: value}))
    for name, values in {
        "latitude_deg": ["91", ""],
        "longitude_deg": ["", "1e30"],
        "altitude_m": ["", "-1e30", "-9000"],
        "fov_deg": ["0", "-5", "180", "400"],
        "solar_distance_au": ["0", "-1"],
        "sun_elevation_deg": ["95", "-95"],
        "time": ["yesterday", "2010-13-01"],
        "look_longitude_deg": ["5"],
        "qw": ["1"],
        "nothing": ["5"],
        "view_id": ["a/b", "..", "\x1b[31m"],
    }.items():
        for value in values:
            yield Case(f"trajectory: {name} is {value!r}", TRAJECTORY, "views.csv", row(**{name: value}))
    header = ",".join(GOOD_ROW)
    line = ",".join(str(v) for v in GOOD_ROW.values())
    for name, content in {
        "empty": "", "header alone": header + "\n", "comments alone": "# a\n# b\n", "binary": bytes(range(256)),
        "two views of one name": f"{header}\n{line}\n{line}\n", "too many cells": f"{header}\n{line},1,2\n",
        "too few cells": f"{header}\na,1\n", "a column twice": f"{header},fov_deg\n{line},10\n", "null bytes": f"{header}\n{line}\0\n",
    }.items():  # fmt: skip
        yield Case(f"trajectory: {name}", TRAJECTORY, "views.csv", text("views.csv", content))
    for path in ("nowhere.csv", ".", "/dev/zero"):
        words = [path if word == "views.csv" else word for word in TRAJECTORY]
        yield Case(f"trajectory: {path}", words, path)


def _leaves(document: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in document.items():
        yield (*above, key)
        if isinstance(value, dict):
            yield from _leaves(value, (*above, key))


def _isds() -> Iterator[Case]:
    arguments = [*INGEST, "images.csv"]
    good = isd()
    beside = {
        ("center_ephemeris_time",),
        ("instrument_position", "velocities"),
        ("sun_position", "velocities"),
    }  # may be left out

    def changed(path: tuple[str, ...], value: Any) -> Callable[[Path], None]:
        def prepare(folder: Path) -> None:
            document = copy.deepcopy(good)
            at = document
            for key in path[:-1]:
                at = at[key]
            if value is ...:
                del at[path[-1]]
            else:
                at[path[-1]] = value
            (folder / "isd.json").write_text(json.dumps(document))
            _column("camera", "isd.json")(folder)

        return prepare

    for path in _leaves(good):
        if path in beside:
            continue
        for value in (..., None, "text", [], {"a": 1}, [[1, 2], [3]], float("nan")):
            yield Case(f"ISD: {'.'.join(path)} = {value!r}", arguments, "", changed(path, value))
    for path, values in {
        ("image_lines",): [0, -1, 1.5, 1e30],
        ("image_samples",): [0, -1, 1.5, 1e30],
        ("name_model",): ["USGS_ASTRO_SAR_SENSOR_MODEL", 5],
        ("focal_length_model", "focal_length"): [0.0, 1e400],
        ("radii", "semimajor"): [0.0, -1737.4],
        ("radii", "unit"): ["furlong"],
        ("focal2pixel_lines",): [[0.0, 0.0, 0.0]],
        ("detector_line_summing",): [0, -1],
        ("instrument_position", "ephemeris_times"): [[5.0, 4.0, 3.0], [1000.0]],
        ("instrument_pointing", "quaternions"): [[[0.0] * 4] * 30, [[1.0, 0.0, 0.0]] * 30],
    }.items():
        for value in values:
            yield Case(f"ISD: {'.'.join(path)} is {str(value)[:30]}", arguments, "", changed(path, value))


def _parts() -> Iterator[Case]:
    def file(name: str, change: Callable[[h5py.File], None]) -> Callable[[Path], None]:
        def prepare(folder: Path) -> None:
            with h5py.File(folder / name, "r+") as handle:
                change(handle)

        return prepare

    def attribute(name: str, value: Any) -> Callable[[Path], None]:
        return file("part_2.h5", lambda handle: handle.attrs.__setitem__(name, value))

    for number, parts in enumerate(
        (["part_1.h5"], ["part_1.h5"] * 2, ["part_1.h5", "pairs.h5"], ["part_1.h5", "scene.h5"], ["part_1.h5", "crops.h5"],
         ["part_1.h5", "nowhere.h5"], ["part_1.h5", "."], ["part_1.h5", "dem.tif"], ["part_1.h5", "/dev/zero"], [])
    ):  # fmt: skip
        yield Case(f"parts {number}: {' '.join(parts)}", ["merge", *parts, "-o", "out.h5"])
        if parts:
            yield Case(
                f"parts seen together {number}: {' '.join(parts)}", ["merge", *parts, "--virtual", "-o", "out.h5"]
            )
    for name in ("gsd_m", "body_radius_m"):
        for value in (5.5, float("nan"), "text", -1.0):
            yield Case(f"parts: {name} of one is {value!r}", MERGE, "part_2.h5", attribute(name, value))
    for name in ("config", "inputs", "provenance"):
        for value in ("{", "5", "", "[1]"):
            yield Case(f"parts: {name} of one is {value!r}", MERGE, "", attribute(name, value))
    for name in ("elevation", "image", "valid", "split", "image_index"):

        def delete(handle: h5py.File, name: str = name) -> None:
            del handle[name]

        yield Case(f"parts: /{name} missing in one", MERGE, "part_2.h5", file("part_2.h5", delete))
    for share in (0.0, 0.1, 0.6, 0.99):
        yield Case(f"parts: first {share:.0%} of one", MERGE, "part_2.h5", _cut("part_2.h5", share))


def _conversions() -> Iterator[Case]:
    def words(**change: str) -> list[str]:
        out = list(CONVERT)
        for option, value in change.items():
            out[out.index("--" + option) + 1] = value
        return out

    for value in ("", "nothing", "lunargr:", ":M2", "lunargr:nothing", "a:b:c", "\x1b[31m", "sato:Hapke"):
        yield Case(f"convert: from {value!r}", words(**{"from": value}))
        yield Case(f"convert: to {value!r}", words(to=value))
    for value in ("", "a", "a,b,c,d", "a=1", "a=0,b=1,c=2", "a=1,b=2,c=99", "a=x,b=2,c=3", "a,a,a"):
        yield Case(f"convert: bands {value!r}", [*CONVERT, "--bands", value])
    for name, change in {
        "of one band": {"count": 1}, "without band names": {"values": lambda a: a}, "complex": {"values": lambda a: a.astype("c8")},
    }.items():  # fmt: skip
        yield Case(f"converted map {name}", CONVERT, "maps.tif", raster("maps.tif", **change))
    for name, content in {
        "empty": b"",
        "text": b"no raster\n",
        "HDF5 garbage": b"\x89HDF\r\n\x1a\n" + bytes(64),
    }.items():
        yield Case(f"converted map: {name}", CONVERT, "maps.tif", text("maps.tif", content))
    for path in ("nowhere.tif", ".", "/dev/zero", "pairs.h5"):
        yield Case(f"converted map: {path}", ["convert", path, *CONVERT[2:]], path)
    for share in (0.05, 0.5, 0.9):
        yield Case(f"converted map: first {share:.0%}", CONVERT, "maps.tif", _cut("maps.tif", share))
