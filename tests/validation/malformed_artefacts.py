"""Artefacts with one thing wrong in each: by their declaration, field by field, and what no declaration says."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
from malformed import HUGE, Case

from schemas.declaration import ROOT_ATTRIBUTES, SCHEMAS, STRING, Attribute, Variable

Change = Callable[[h5py.File], None]

# The commands that read each artefact, with OTHER for the mutated file; every mutation takes the next one.
READERS: dict[str, list[list[str]]] = {
    kind: [line.split() for line in lines]
    for kind, lines in {
        "scene": [
            "sample scene.h5 --count 20 -o out.h5",
            "infer scene.h5 checkpoint.h5 -o out.h5",
            "render --dem scene.h5 --model M2 --sun-azimuth 90 --sun-elevation 30 -o out.exr",
            "ingest scene.h5 --images images.csv --crop 32 -o out.h5",
            "albedo svbrdf.h5 scene.h5 -o out.h5",
            "report scene.h5 -o out.html",
        ],
        "crops": [
            "project crops.h5 -o out.h5",
            "inspect crops.h5",
        ],
        "pairs": [
            "train pairs.h5 --epochs 1 --widths 4-8 --device cpu --precision fp32 -o out.h5",
            "evaluate pairs.h5 checkpoint.h5 --device cpu -o out.h5",
            "match pairs.h5 checkpoint.h5 --count 1 --device cpu --json out.json",
            "diagnose pairs.h5 -o out.h5",
            "report pairs.h5 -o out.html",
        ],
        "checkpoint": [
            "infer scene.h5 checkpoint.h5 --device cpu -o out.h5",
            "evaluate pairs.h5 checkpoint.h5 --device cpu -o out.h5",
            "match pairs.h5 checkpoint.h5 --count 1 --device cpu --json out.json",
            "export checkpoint.h5 -o out.onnx",
        ],
        "svbrdf": [
            "render svbrdf.h5 --sun-azimuth 90 --sun-elevation 30 -o out.exr",
            "albedo svbrdf.h5 scene.h5 -o out.h5",
            "view svbrdf.h5 -o out.html",
            "report svbrdf.h5 -o out.html",
        ],
        "evaluation": [
            "match evaluation.h5 --count 1 --json out.json",
            "report evaluation.h5 -o out.html",
        ],
        "diagnosis": [
            "render svbrdf.h5 --extend diagnosis.h5 --sun-azimuth 90 --sun-elevation 30 -o out.exr",
            "inspect diagnosis.h5",
            "report diagnosis.h5 -o out.html",
        ],
    }.items()
}


def artefact_cases() -> Iterator[Case]:
    """Every mutation of every artefact."""
    for kind, readers in READERS.items():
        for number, (name, change) in enumerate((*_declared(kind), *_links(kind))):
            yield Case(f"{kind}: {name}", readers[number % len(readers)], f"{kind}.h5", _changed(f"{kind}.h5", change))
        deep = [r for r in readers if r[0] not in ("report", "inspect")]  # these show a file and use nothing of it
        for number, (name, change) in enumerate(_by_hand(kind)):
            yield Case(f"{kind}: {name}", deep[number % len(deep)], f"{kind}.h5", _changed(f"{kind}.h5", change))
        for share in (0.0, 0.02, 0.3, 0.7, 0.99):
            yield Case(
                f"{kind}: first {share:.0%} of the file", readers[0], f"{kind}.h5", _truncated(f"{kind}.h5", share)
            )


def _changed(name: str, change: Change) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        with h5py.File(folder / name, "r+") as file:
            change(file)

    return prepare


def _truncated(name: str, share: float) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        os.truncate(folder / name, int(share * (folder / name).stat().st_size))

    return prepare


def replace(name: str, make: Callable[[np.ndarray], np.ndarray]) -> Change:
    """A variable's values changed; its attributes and type as they were where the type still fits."""

    def change(file: h5py.File) -> None:
        old = file[name]
        kept, values = dict(old.attrs), old[...]
        for key in ("DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME", "_Netcdf4Dimid"):
            kept.pop(key, None)
        del file[name]
        data = file.create_dataset(name, data=make(values))
        for key, value in kept.items():
            data.attrs[key] = value

    return change


def delete(name: str) -> Change:
    def change(file: h5py.File) -> None:
        del file[name]

    return change


def put(name: str, make: Callable[[h5py.File], None]) -> Change:
    """``name`` replaced by something that ``make`` puts there."""

    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        make(file)

    return change


def attribute(name: str, value: object) -> Change:
    def change(file: h5py.File) -> None:
        file.attrs[name] = value

    return change


def _first(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def make(values: np.ndarray) -> np.ndarray:
        changed = values.astype(np.float64)
        changed.flat[0] = value
        return changed

    return make


def _declared(kind: str) -> Iterator[tuple[str, Change]]:
    schema = SCHEMAS[kind]
    for v in schema.variables:
        if v.required:
            yield from _variable(v)
    for a in (*ROOT_ATTRIBUTES, *schema.attributes):
        yield from _attribute(a)


def _variable(v: Variable) -> Iterator[tuple[str, Change]]:
    yield f"/{v.name} missing", delete(v.name)
    yield f"/{v.name} of another rank", replace(v.name, lambda a: np.zeros((*a.shape, 2), "f4"))
    yield f"/{v.name} a group", put(v.name, lambda f: f.create_group(v.name))
    if v.dtype == STRING:
        yield f"/{v.name} numbers", replace(v.name, lambda a: np.arange(len(a)))
        yield f"/{v.name} no UTF-8", replace(v.name, lambda a: np.array([b"\xff\xfe"] * len(a), "S2"))
        yield f"/{v.name} escape codes", replace(v.name, lambda a: np.array([b"\x1b[31mred"] * len(a), "S9"))
        return
    yield f"/{v.name} text", replace(v.name, lambda a: np.full(a.shape, b"text", "S4"))
    yield f"/{v.name} complex", replace(v.name, lambda a: np.zeros(a.shape, "c8"))
    yield f"/{v.name} in another unit", lambda f: f[v.name].attrs.__setitem__("units", "furlong")
    if len(v.dims) == 1 and v.name not in v.dims:
        yield f"/{v.name} too long", replace(v.name, lambda a: np.concatenate([a, a[:1]]))
    if not v.is_table:
        return
    if v.finite or v.unit_vector or np.dtype(v.dtype).kind in "iu":
        yield f"/{v.name} NaN", replace(v.name, _first(np.nan))
        yield f"/{v.name} infinite", replace(v.name, _first(np.inf))
    if np.dtype(v.dtype).kind in "iu":
        yield f"/{v.name} broken", replace(v.name, _first(0.5))
    if v.unit_vector:
        yield f"/{v.name} zero", replace(v.name, lambda a: 0 * a)
        yield f"/{v.name} huge", replace(v.name, lambda a: HUGE * a)
    if v.flags or v.index_of or v.minimum is not None:
        yield f"/{v.name} below", replace(v.name, _first(-HUGE))
    if v.flags or v.index_of or v.maximum is not None:
        yield f"/{v.name} above", replace(v.name, _first(HUGE))


def _attribute(a: Attribute) -> Iterator[tuple[str, Change]]:
    where = f"attribute {a.name}"
    if a.required:
        yield f"{where} missing", lambda f: f.attrs.__delitem__(a.name)
    if a.kind in ("number", "integer"):
        wrong: list[object] = ["text", np.nan, np.inf, -HUGE, np.array([5.0, 5.0]), h5py.Empty("f8"), 1 + 2j]
        wrong += [0.0] if a.minimum is not None and a.minimum > 0 else []
        wrong += [HUGE] if a.maximum is not None else []
        wrong += [1.5] if a.kind == "integer" else []
    elif a.kind.startswith("json"):
        wrong = ["{", "", "5", "null", "[" * 100_000, '{"a": "\\ud800"}', b"\xff\xfe", 7.0]
        wrong.append("{}" if a.kind == "json list" else "[]")
    else:
        wrong = [7.0, b"\xff\xfe", np.array([1, 2])] + (["furlong"] if a.choices else [])
    for value in wrong:
        yield f"{where} = {str(value)[:20]!r}", attribute(a.name, value)


def _links(kind: str) -> Iterator[tuple[str, Change]]:
    schema = SCHEMAS[kind]
    for v in [v for v in schema.variables if v.required][:8]:

        def external(f: h5py.File, name: str = v.name) -> None:
            f[name] = h5py.ExternalLink("pairs.h5" if kind != "pairs" else "scene.h5", "/elevation")

        def loop(f: h5py.File, name: str = v.name) -> None:
            f[name] = h5py.SoftLink(f"/{name}")

        def outside(f: h5py.File, name: str = v.name, v: Variable = v) -> None:
            f.create_dataset(name, (1,) * len(v.dims), "u1", external=[("/etc/hostname", 0, 1)])

        yield f"/{v.name} an external link", put(v.name, external)
        yield f"/{v.name} a link to itself", put(v.name, loop)
        yield f"/{v.name} kept in a system file", put(v.name, outside)
    yield "another data set kept in a system file", put("more", lambda f: _outside(f, "more"))
    yield "a dangling link", put("more", lambda f: f.__setitem__("more", h5py.SoftLink("/nowhere")))


def _outside(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (1,), "u1", external=[("/etc/hostname", 0, 1)])


def _by_hand(kind: str) -> Iterator[tuple[str, Change]]:
    """What follows from no range of a single value."""
    yield "another schema", attribute("lunargr_schema", "truth")
    yield "an unknown schema", attribute("lunargr_schema", "nothing")
    yield "schema_version 99", attribute("schema_version", 99)
    if kind in ("svbrdf", "checkpoint"):
        yield "an unknown model", attribute("model", "furlong")
    if kind in ("scene", "svbrdf"):
        for value in (
            "",
            "1 2 3",
            "a b c d e f",
            "0 nan 0 0 0 -20",
            "0 -20 0 0 0 20",
            "0 40 0 0 0 -40",
            "0 20 5 0 5 -20",
        ):
            yield f"GeoTransform '{value}'", lambda f, v=value: f["crs"].attrs.__setitem__("GeoTransform", v)
        mars = 'GEOGCS["m",DATUM["m",SPHEROID["m",3396190,0]],PRIMEM["r",0],UNIT["degree",0.0174532925199433]]'
        for value in ("", "nonsense", mars):
            yield f"crs_wkt '{value[:10]}'", lambda f, v=value: f["crs"].attrs.__setitem__("crs_wkt", v)
        yield "no crs", delete("crs")
        yield "another body's radius", attribute("body_radius_m", 3389500.0)
        yield "another gsd", attribute("gsd_m", 1.25)
    if kind == "crops":
        yield "a scene that is not there", attribute("scene", "nowhere.h5")
        yield "the hash of another scene", attribute("scene_sha256", "0" * 64)
        yield (
            "the hash of another image",
            replace("sha256", lambda a: np.array([b"%064d" % k for k in range(len(a))], "S64")),
        )
        yield "an image that is not there", replace("path", lambda a: np.array([b"nowhere.tif"] * len(a), "S11"))
        yield "crops off the scene", replace("row", lambda a: a + 100_000)
        yield "crops of an odd size", attribute("crop_px", np.int32(31))
    if kind == "pairs":
        yield "nothing valid", replace("valid", lambda a: 0 * a)
        yield "images all NaN", replace("image", lambda a: np.nan * a)
        yield "heights all NaN", replace("elevation", lambda a: np.nan * a)
        yield "no pairs at all", _without_pairs
        yield "a camera at the crop", replace("camera_position_enu", lambda a: 0 * a)
    if kind == "checkpoint":
        yield from _weights()
    if kind == "diagnosis":
        for value in ('[5]', '[{"effect": "nothing"}]', '[{"effect": "dark_bias"}]', '[{"effect": "dark_bias", "values": {"iof": "x"}, "survey": {}}]',
                      '[{"effect": "dark_bias", "values": {"nothing": 1.0}, "survey": {}}]', '[{"effect": "dark_bias", "values": {"iof": NaN}, "survey": {}}]'):  # fmt: skip
            yield f"extension {value[:60]}", attribute("extension", value)


def _without_pairs(file: h5py.File) -> None:
    for name in list(file):
        shape = file[name].shape
        if shape and shape[0] == file["valid"].shape[0] and name not in ("image_id", "solar_distance_au", "valid"):
            replace(name, lambda a: a[:0])(file)
    replace("valid", lambda a: a[:0])(file)


def _weights() -> Iterator[tuple[str, Change]]:
    yield "no weights", delete("weights")
    yield "weights a data set", put("weights", lambda f: f.create_dataset("weights", data=np.zeros(3)))

    def each(make: Callable[[np.ndarray], np.ndarray]) -> Change:
        def change(file: h5py.File) -> None:
            for name in list(file["weights"]):
                values = file["weights"][name][...]
                del file["weights"][name]
                file["weights"].create_dataset(name, data=make(values))

        return change

    yield "weights NaN", each(lambda a: a * np.nan if a.dtype.kind == "f" else a)
    yield "weights infinite", each(lambda a: a + np.inf if a.dtype.kind == "f" else a)
    yield "weights text", each(lambda a: np.full(a.shape, b"text", "S4"))
    yield "weights of another shape", each(lambda a: np.concatenate([a.ravel(), a.ravel()[:1]]))
    yield "one array too many", lambda f: f["weights"].__setitem__("more", np.zeros(3))
    yield "one array missing", lambda f: f["weights"].__delitem__(sorted(f["weights"])[0])
    for text in (
        '{"widths": [4, 4, 8], "dropout": [0.0, 0.0, 0.0], "model": "hapke"}', '{"widths": [1000000, 1000000], "dropout": [0.0]}',
        '{"widths": [100000000000, 8], "dropout": [0.0]}', '{"widths": [], "dropout": []}', '{"widths": "wide", "dropout": [0.0]}',
        '{"widths": [-4, 8], "dropout": [0.0]}', '{"widths": [4.5, 8], "dropout": [0.0]}', '{"widths": [4, 4, 8], "dropout": [NaN]}',
        '{"widths": [4, 4, 8], "dropout": [1.0]}', '{"widths": [4, 4, 8]}', '{}', '{"widths": [60000, 60000, 60000], "dropout": [0.0]}',
        '{"widths": [4, 4, 16], "dropout": [0.0]}',
    ):  # fmt: skip
        yield f"config {text[:50]}", attribute("config", text)
    for names in ("[]", '["a"]', "[1, 2, 3]", '["c", "b", "a"]'):
        yield f"coefficients {names}", attribute("coefficients", names)
