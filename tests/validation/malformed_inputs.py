"""The user's own files and options with one thing wrong in each: tables, cameras, recipes, rasters, values of options."""

from __future__ import annotations

import csv
import importlib
import json
import os
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_type_hints

import numpy as np
import rasterio
import small_scene
from malformed import Case
from rasterio.crs import CRS
from rasterio.transform import Affine

INGEST = ["ingest", "dem.tif", "--gsd", "20", "--crop", "32", "-o", "out.h5", "--images"]
RENDER = ["render", "svbrdf.h5", "--sun-azimuth", "90", "--sun-elevation", "30", "-o", "out.exr"]
SIMULATE = ["simulate", "--print-recipe"]
# What an option's command needs beside it, to come as far as the option's own value; also run with good files.
BASE: dict[str, list[str]] = {
    words[0]: words
    for words in (
        SIMULATE,
        RENDER,
        *map(
            str.split,
            (
                "ingest dem.tif --images images.csv --gsd 20 --crop 32 -o out.h5",
                "sample scene.h5 -o out.h5",
                "project crops.h5 -o out.h5",
                "train pairs.h5 --epochs 1 --widths 4-8 --device cpu --precision fp32 -o out.h5",
                "infer scene.h5 checkpoint.h5 --device cpu -o out.h5",
                "evaluate pairs.h5 checkpoint.h5 --device cpu -o out.h5",
                "match pairs.h5 checkpoint.h5 --device cpu --json out.json",
                "compare pairs.h5 -o out --epochs 1 --seeds 1 --widths 4-8 --device cpu",
                "diagnose pairs.h5 -o out.h5",
            ),
        ),
    )
}
CONTROLS = [v for k, v in BASE.items() if k not in ("compare", "diagnose")] + [
    [*RENDER[:6], "--camera", "camera.json", "-o", "out.exr"],
    [*INGEST, "images.json"],
]

Row = dict[str, Any]


def _read_rows(folder: Path) -> list[Row]:
    with open(folder / "images.csv", newline="") as stream:
        return list(csv.DictReader(stream))


def _write_rows(path: Path, rows: list[Row]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _column(name: str, value: str, only: bool = True) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        rows = _read_rows(folder)
        for row in rows[: 1 if only else None]:
            row[name] = value
        _write_rows(folder / "images.csv", rows)

    return prepare


def text(name: str, content: bytes | str) -> Callable[[Path], None]:
    """A file with this content."""

    def prepare(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))

    return prepare


def table_cases() -> Iterator[Case]:
    numbers = ("subsolar_longitude_deg", "subsolar_latitude_deg", "solar_distance_au", "spacecraft_longitude_deg", "spacecraft_latitude_deg", "spacecraft_altitude_m")  # fmt: skip
    for name in numbers:
        values = ["text", "nan", "inf", "-1e30", "1e30", "1e999", "--5", "0x10", "1,5", "\x1b[31m5"]
        values += ["" if name != "solar_distance_au" else "0"]  # an ephemeris knows the distance
        for value in values:
            yield Case(f"table: {name} = {value!r}", [*INGEST, "images.csv"], "images.csv", _column(name, value))
    for name, values in {
        "image_id": ["", "\x1b[31mred\x1b[0m", "a\x07b", "IMG1"],
        "path": ["", "nowhere.tif", ".", "dem.tif\x00", "images.csv", "/dev/zero"],
        "units": ["", "furlong", "IOF DN", "0"],
        "start_time": ["yesterday", "2010-13-45", "2010-01-01T25:00:00", "20100101", "nan", "1e30"],
        "camera": ["nowhere.json", ".", "images.csv", "/dev/zero", "dem.tif"],
    }.items():
        for value in values:
            yield Case(f"table: {name} = {value!r}", [*INGEST, "images.csv"], "", _column(name, value))
    header = b"image_id,path,units\n"
    contents = {
        "empty": b"", "header alone": header, "binary": bytes(range(256)), "UTF-16": "image_id,path\na,b\n".encode("utf-16"),
        "no header": b"IMG0,image0.tif,iof\n", "null bytes": header + b"a\0b,c,iof\n", "one huge field": header + b"a" * 200_000 + b",b,iof\n",
        "too many cells": header + b"a,b,iof," + b"x," * 50 + b"\n", "an HDF5 file": b"\x89HDF\r\n\x1a\n" + b"\0" * 100,
    }  # fmt: skip
    for name, content in contents.items():
        yield Case(f"table: {name}", [*INGEST, "images.csv"], "images.csv", text("images.csv", content))
    deep = "[" * 200_000
    documents = ["", "5", "null", '"text"', "[1, 2]", "[[]]", "{}", "[]", '{"images": 5}', '{"images": [5]}', "{", deep, deep + "]" * 200_000,
                 '[{"image_id": "\\ud800", "path": "image0.tif"}]', '[{"image_id": {"a": 1}, "path": []}]', "[NaN]", "[{}]", "1" * 10_000]  # fmt: skip
    for number, document in enumerate(documents):
        name = f"JSON table {number}: {document[:18]}"
        yield Case(name, [*INGEST, "images.json"], "images.json", text("images.json", document))
    for path in ("nowhere.csv", ".", "/dev/zero", "/dev/null", "/dev/zero.json"):
        yield Case(f"table: --images {path}", [*INGEST, path], path)
    yield Case("table: a pipe", [*INGEST, "pipe.csv"], "pipe.csv", lambda folder: os.mkfifo(folder / "pipe.csv"))
    yield Case(
        "table: a link to itself", [*INGEST, "loop.csv"], "loop.csv", lambda f: (f / "loop.csv").symlink_to("loop.csv")
    )


def write_camera(path: Path) -> None:
    """A pinhole camera over the small scene, and the table once more as JSON beside it."""
    from camera_rays import looking_at

    from stages.physics.maps.grid import unit_vectors

    up = unit_vectors(small_scene.LON, small_scene.LAT)
    camera = looking_at(
        position=up * (small_scene.RADIUS + 9000.0), target=up * small_scene.RADIUS, field_of_view=0.2, size=(24, 24), radius=small_scene.RADIUS
    )  # fmt: skip
    path.write_text(json.dumps(camera.to_document()))
    (path.parent / "images.json").write_text(json.dumps(_read_rows(path.parent)))


def _key(name: str, value: Any) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        document = json.loads((folder / "camera.json").read_text())
        document[name] = value
        if value is ...:
            del document[name]
        text("camera.json", json.dumps(document))(folder)

    return prepare


def camera_cases() -> Iterator[Case]:
    arguments = [*RENDER[:6], "--camera", "camera.json", "-o", "out.exr"]
    infinite, nan = float("inf"), float("nan")
    for name in ("focal_px", "principal_point_px", "size_px", "position_mcmf", "rotation_camera_to_mcmf"):
        for value in (
            ...,
            None,
            "text",
            [],
            [1.0],
            [nan, nan],
            [infinite] * 3,
            {"a": 1},
            [[1, 2], [3]],
            [1e30] * 9,
            [True, "x"],
        ):
            yield Case(f"camera: {name} = {value!r}", arguments, "camera", _key(name, value))
    for name, values in {
        "focal_px": [0.0, [-5.0, 5.0]],
        "size_px": [[0, 24], [2.5, 24], [-24, 24], [1e9, 1e9]],
        "rotation_camera_to_mcmf": [
            np.zeros((3, 3)).tolist(),
            (2 * np.eye(3)).tolist(),
            np.diag([1.0, 1.0, -1.0]).tolist(),
        ],
        "position_mcmf": [[0.0, 0.0, 0.0]],
        "type": [..., "telescope", 5, None, ["pinhole"], {"a": 1}],
        "body": ["pluto2", -5, [], 3389500.0],
    }.items():
        for value in values:
            yield Case(
                f"camera: {name} = {str(value)[:40]}", arguments, "camera" if name != "body" else "", _key(name, value)
            )
    for number, document in enumerate(["", "5", "[]", "null", "{", "[" * 200_000, "{}", '{"type": "\\ud800"}', "\xff"]):
        content = document.encode("latin-1")
        yield Case(
            f"camera: document {number} {document[:12]!r}", arguments, "camera.json", text("camera.json", content)
        )


def recipe_cases() -> Iterator[Case]:
    arguments = [*SIMULATE, "--recipe", "recipe.json"]
    documents = ["", "5", "[]", "{", "[" * 200_000, '{"unknown": 5}', '{"hidden": [5]}', '{"hidden": [{"effect": "nothing"}]}',
                 '{"hidden": [{"effect": "dark_bias", "iof": 1e9}]}', '{"parameters": {"w": "x"}}', '{"parameters": [1]}', '{"model": 5}',
                 '{"altitude": [1]}', '{"altitude": ["a", "b"]}', '{"altitude": [NaN, NaN]}', '{"units": "furlong"}', '{"units": "\\ud800"}']  # fmt: skip
    for number, document in enumerate(documents):
        yield Case(f"recipe {number}: {document[:30]}", arguments, "", text("recipe.json", document))
    for key in (
        "size_px",
        "images",
        "gsd",
        "dem_gsd",
        "seed",
        "hurst",
        "latitude_deg",
        "crater_density",
        "dem_holes",
        "base_elevation",
    ):
        for value in ("NaN", "Infinity", "-1e30", '"text"', "null", "[]", "true", "1e400"):
            yield Case(
                f"recipe: {key} = {value}", arguments, "recipe.json", text("recipe.json", f'{{"{key}": {value}}}')
            )
    for key in ("size_px", "images", "seed", "dem_holes"):
        yield Case(
            f"recipe: {key} = 10^18.5",
            arguments,
            "recipe.json",
            text("recipe.json", f'{{"{key}": 31622776601683793320}}'),
        )
    yield Case("recipe: /dev/zero", [*SIMULATE, "--recipe", "/dev/zero"], "/dev/zero")


def raster(name: str, **change: Any) -> Callable[[Path], None]:
    """A raster of the scene written again with another profile, other ``values`` or another band ``unit``."""

    def prepare(folder: Path) -> None:
        with rasterio.open(folder / name) as source:
            values, profile, tags = source.read(1), source.profile, change
        values = tags["values"](values) if "values" in tags else values
        profile |= {k: v for k, v in tags.items() if k not in ("values", "unit", "scale")}
        profile["dtype"] = values.dtype
        if "complex" in values.dtype.name:
            profile["nodata"] = None
        with rasterio.open(folder / name, "w", **profile) as out:
            for band in range(1, profile["count"] + 1):
                out.write(values, band)
            if "unit" in tags:
                out.units = (tags["unit"],) * profile["count"]
            if "scale" in tags:
                out.scales = (tags["scale"],) * profile["count"]

    return prepare


def raster_cases() -> Iterator[Case]:
    from stages.physics.maps.grid import local_metric_crs

    dem, render = [*INGEST, "images.csv"], ["render", "--dem", "dem.tif", *RENDER[2:]]
    step = 1e-3
    feet = 'COMPD_CS["c",%s,VERT_CS["NAVD88 height (ftUS)",VERT_DATUM["North American Vertical Datum 1988",2005,AUTHORITY["EPSG","5103"]],UNIT["US survey foot",0.304800609601219,AUTHORITY["EPSG","9003"]],AXIS["Gravity-related height",UP],AUTHORITY["EPSG","6360"]]]'
    wkt = local_metric_crs(small_scene.LON, small_scene.LAT, small_scene.RADIUS).to_wkt(version="WKT1_GDAL")
    changes: dict[str, dict[str, Any]] = {
        "in feet": {"unit": "ft"}, "in US survey feet": {"unit": "US survey foot"}, "in kilometres": {"unit": "km"}, "in furlongs": {"unit": "furlong"},
        "in feet by its CRS": {"crs": CRS.from_wkt(feet % wkt)}, "of three bands": {"count": 3}, "complex": {"values": lambda a: a.astype("c8")},
        "all nodata": {"values": lambda a: np.full_like(a, -9999)}, "all NaN": {"values": lambda a: a * np.nan}, "all infinite": {"values": lambda a: a + np.inf},
        "without CRS": {"crs": None}, "of Mars": {"crs": CRS.from_proj4("+proj=longlat +a=3396190 +b=3376200 +no_defs")},
        "of pixels without size": {"transform": Affine(0, 0, 0, 0, 0, 0)}, "of NaN pixels": {"transform": Affine(np.nan, 0, 0, 0, np.nan, 0)},
        "of huge heights": {"values": lambda a: a * 1e30}, "of kilometres": {"values": lambda a: a * 1e-3}, "of millimetres": {"values": lambda a: a * 1e3},
        "of radii in kilometres": {"values": lambda a: a * 1e-3 + 1737.4}, "scaled by NaN": {"scale": float("nan")}, "scaled by 0": {"scale": 0.0},
        "at longitude +720 deg": {
            "crs": CRS.from_proj4(f"+proj=longlat +R={small_scene.RADIUS} +no_defs"), "transform": Affine(step, 0, 740, 0, -step, 10)},
        "beyond the pole": {"crs": CRS.from_proj4(f"+proj=longlat +R={small_scene.RADIUS} +no_defs"), "transform": Affine(step, 0, 20, 0, -step, 95)},
    }  # fmt: skip
    for name, change in changes.items():
        yield Case(f"DEM {name}", dem, "", raster("dem.tif", **change))
    for name in ("in feet", "of three bands", "complex", "all nodata", "without CRS", "of Mars", "in feet by its CRS"):
        yield Case(f"rendered DEM {name}", render, "dem.tif", raster("dem.tif", **changes[name]))
        yield Case(
            f"inferred DEM {name}",
            ["infer", "dem.tif", "checkpoint.h5", "-o", "out.h5"],
            "dem.tif",
            raster("dem.tif", **changes[name]),
        )
    contents: dict[str, bytes] = {
        "empty": b"", "text": b"no raster\n", "HDF5 garbage": b"\x89HDF\r\n\x1a\n" + bytes(range(256)) * 8, "a TIFF's head": b"II*\0\xff\xff\xff\x7f", "PNG garbage": b"\x89PNG\r\n\x1a\n" + b"\0" * 64,
        "a VRT of itself": b'<VRTDataset rasterXSize="8" rasterYSize="8"><VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="1">dem.tif</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>',
    }  # fmt: skip
    for name, content in contents.items():
        yield Case(f"DEM: {name}", dem, "dem.tif", text("dem.tif", content))
        yield Case(f"image: {name}", dem, "image0.tif", text("image0.tif", content))
        yield Case(
            f"infer: {name}", ["infer", "dem.tif", "checkpoint.h5", "-o", "out.h5"], "dem.tif", text("dem.tif", content)
        )
    for path in ("nowhere.tif", ".", "/dev/zero", "/dev/null", "pairs.h5", "images.csv"):
        yield Case(f"DEM: {path}", [dem[0], path, *dem[2:]], path)
        yield Case(f"infer: {path}", ["infer", path, "checkpoint.h5", "-o", "out.h5"], path)
    for name in (
        "complex",
        "without CRS",
        "of Mars",
        "of three bands",
        "scaled by NaN",
        "of NaN pixels",
        "of pixels without size",
    ):
        yield Case(f"image {name}", dem, "image0.tif", raster("image0.tif", **changes[name]))
    for share in (0.05, 0.5, 0.9):
        yield Case(f"DEM: first {share:.0%}", dem, "dem.tif", _cut("dem.tif", share))
        yield Case(f"image: first {share:.0%}", dem, "image0.tif", _cut("image0.tif", share))
    yield Case(
        "image of other contents than sample saw",
        BASE["project"],
        "image0.tif",
        raster("image0.tif", values=lambda a: a * 1.5),
    )
    yield Case(
        "image gone since sample", BASE["project"], "image0.tif", lambda folder: (folder / "image0.tif").unlink()
    )
    yield Case(
        "image all nodata",
        dem,
        "",
        raster("image0.tif", values=lambda a: np.full_like(a, -1e4)),
        "image0.tif: image 'IMG0' has no valid pixel",
    )
    yield Case("DEM sparse and all nodata, 300,000 px a side", dem, "dem.tif", _sparse)
    yield Case("infer --body mars on a scene", [*BASE["infer"], "--body", "mars"], "scene.h5")
    yield Case("render --body mars on a map", [*RENDER, "--body", "mars"], "svbrdf.h5")
    yield Case("no validation pairs", BASE["train"], "", _without_validation, "no validation pairs")


def _cut(name: str, share: float) -> Callable[[Path], None]:
    return lambda folder: os.truncate(folder / name, int(share * (folder / name).stat().st_size))


def _sparse(folder: Path) -> None:
    size, half = 300_000, 150_000.0
    profile = {"driver": "GTiff", "height": size, "width": size, "count": 1, "dtype": "float32", "nodata": -9999.0}
    more = {"tiled": True, "blockxsize": 512, "blockysize": 512, "sparse_ok": True, "bigtiff": "yes"}
    place = {"crs": small_scene.local_crs(), "transform": Affine(1, 0, -half, 0, -1, half)}
    with rasterio.open(folder / "dem.tif", "w", **profile, **more, **place):
        pass


def _without_validation(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "pairs.h5", "r+") as file:
        file["split"][...] = 0


# --- values of options ------------------------------------------------------------------------------------------------

# Good ones among the values below: (option, value), for any command that has it.
GOOD = {
    ("--fit-pairs", "0"), ("--seed", "0"), ("--roll", "0"),
    ("--roll", "-1"), ("--sun-azimuth", "0"), ("--sun-azimuth", "-1"), ("--seed", "1000000000"), ("--count", "1000000000"),
    ("--fit-pairs", "1000000000"), ("--batch", "1000000000"), ("--window", "1000000000"),
    ("--brightness", "0"), ("--pairs", "1000000000"), ("--parts", "1000000000"),
}  # fmt: skip
TEXTS = {
    "--shard": ["", "1", "0/3", "4/3", "1/0", "a/b", "1/1000000000", "-1/3", "1/2/3", "\u00b2/3", "1/1e3"],
    "--device": ["", "meta", "cuda:99", "gpu", "cpu:x", "mps", "xla", "\x1b[31m"],
    "--body": ["", "pluto2", "0", "-5", "nan", "inf", "1e30"],
    "--scheduler": ["", "local:0", "local:-1", "local:x", "local:1000000000", "local"],
    "--split": ["", "nothing", "0/0/0", "nan/1/1", "-1/1/1", "1/1", "inf/1/1"],
    "--model": ["", "nothing", "\x1b[31m"],
    "--models": ["", "M1", "M1,nothing"],
    "--widths": ["", "a", "0-0", "-4-8", "16", "1000000000-8", "8-" * 20 + "8"],
    "--schedule": ["", "nothing"],
    "--precision": ["", "nothing", "fp8"],
    "--register": ["", "nothing"],
    "--view": ["", "nothing"],
    "--size": ["", "0,0", "a,b", "-5,5", "1000000000,1000000000", "\u00b2,5", "5"],
    "--position": ["", "1,2", "nan,1,1", "a,b,c"],
    "--quaternion": ["", "0,0,0,0", "nan,0,0,0"],
    "--look-at": ["", "x", "1"],
    "--time": ["", "yesterday", "2010-13-01", "nan", "1700-01-01"],
    "--units": ["", "furlong"],
    "--hidden": ["nothing", "dark_bias:iof", "dark_bias:iof=nan", "dark_bias:nothing=1", "dark_bias+dark_bias"],
    "--matcher": ["", "nothing"],
    "--only": ["", "nothing"],
    "--free": ["", ",", "nothing", "w,w"],
    "--maps": ["", ",", "w,w"],
    "--dropout": ["", "a", "1", "0.1-0.1-0.1"],
    "--parameters": ["", "nothing", "w=", "=5", "w=nan", "w=0.2,w=0.3", "w=0.2,"],
}


def _options() -> Iterator[tuple[str, str, type]]:
    """(command, option, type) of every option that takes a value, from the commands' own declarations."""
    import lunargr_cli.commands as commands

    for module in pkgutil.iter_modules(commands.__path__):
        loaded = importlib.import_module(f"lunargr_cli.commands.{module.name}")
        if loaded.NAME not in BASE:
            continue
        for name, hint in get_type_hints(loaded.command, include_extras=True).items():
            declared = next((m for m in getattr(hint, "__metadata__", ()) if hasattr(m, "param_decls")), None)
            if declared is None or type(declared).__name__ != "OptionInfo":
                continue
            option = next((d for d in declared.param_decls or () if d.startswith("--")), f"--{name.replace('_', '-')}")
            kind = get_args(hint)[0]
            kinds = [k for k in get_args(kind) if k is not type(None)] if isinstance(kind, UnionType) else [kind]
            yield loaded.NAME, option.partition("/")[0], kinds[0]


def option_cases() -> Iterator[Case]:
    for command, option, kind in _options():
        if kind is float:
            values = ["nan", "inf", "-inf", "text", "", "1e999"]
            if option not in ("--roll", "--sun-azimuth", "--subsolar-longitude", "--subsolar-latitude"):
                values += ["0", "-1", "1e30"]
        elif kind is int:
            values = ["-1", "0", "1000000000", "1" + "0" * 30, "1.5", "nan", "text", ""]
        else:
            values = TEXTS.get(option, [])
        for value in values:
            if (option, value) not in GOOD:
                arguments = [*BASE[command], option, value]
                yield Case(f"{command} {option} {value!r}", _replaced(arguments, option, value))


def _replaced(arguments: list[str], option: str, value: str) -> list[str]:
    """The option once, with the bad value; --parts and the like with what they go with."""
    words = list(arguments)
    first = words.index(option)
    if first != len(words) - 2:
        del words[first : first + 2]
    if option in ("--subsolar-longitude", "--subsolar-latitude", "--time"):
        words = words[:2] + words[6:]
        if option != "--time":
            other = "--subsolar-latitude" if option.endswith("longitude") else "--subsolar-longitude"
            words += [other, "5"]
    if option == "--parameters":
        words = ["render", "--dem", "dem.tif", *words[2:], "--model", "hapke"]
    if option == "--parts":
        words.append("--resume" if words[0] != "sample" else "--scheduler=local:1")
    return words
