"""Who made an artefact, from what: the command, its version, seed and options, its inputs' hashes, and the same for them.

Every artefact carries the records of all that it descends from, so that the chain outlives the files.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas.checks import any_text, is_foreign, parse_json
from schemas.command_line import running_command
from schemas.declaration import Schema
from schemas.errors import ArtefactError, LunargrError
from schemas.files.hdf5 import open_hdf5
from schemas.files.user_files import read_json
from schemas.rasters import raster_kind, read_raster

CONVENTIONS = "CF-1.11"
SIDECAR = "record.json"  # beside files that cannot carry a record themselves: rasters and tables
Record = dict[str, Any]
# A shard names the same large inputs as the check before it: (path, size, time of change) -> SHA-256.
known_digests: dict[tuple[str, int, int], str] = {}


def sha256(path: Path) -> str:
    """The SHA-256 of a file, worked out once while the file stays as it is."""
    state = os.stat(path)
    key = (os.path.realpath(path), state.st_size, state.st_mtime_ns)
    if key not in known_digests:
        with open(path, "rb") as stream:
            known_digests[key] = hashlib.file_digest(stream, "sha256").hexdigest()
    return known_digests[key]


def changed_inputs() -> list[str]:
    """The files that changed, or went, since this process hashed them."""
    return [path for path, *state in known_digests if file_state(path) != state]


def file_state(path: str | Path) -> list[int]:
    """Size and time of change of a file, by which a change of its content shows; empty where there is no such file."""
    try:
        found = os.stat(path)
    except OSError:
        return []
    return [found.st_size, found.st_mtime_ns]


def describe_run(schema: Schema, config: Mapping[str, Any], inputs: Sequence[Path], seed: int | None) -> dict[str, Any]:
    """The root attributes of an artefact that is being made: by which command, and from which inputs."""
    about = {"title": schema.title, "lunargr_schema": schema.name, "schema_version": np.int32(schema.version)}
    return {"Conventions": CONVENTIONS} | about | _describe(schema.stage, config, inputs, seed)


def raster_record(stage: str, config: Mapping[str, Any], inputs: Sequence[Path]) -> str:
    """The record of a GeoTIFF or EXR that is being made, as one line of JSON: see ``schemas.rasters``."""
    return pack_record({"lunargr_schema": stage} | _describe(stage, config, inputs, None))


def pack_record(root: Mapping[str, Any]) -> str:
    """Root attributes of an artefact as the one line that a raster of the same run holds."""
    record, ancestors = _unpack(root, "the run")
    return json.dumps({"record": record, "provenance": ancestors}, sort_keys=True)


def _describe(stage: str, config: Mapping[str, Any], inputs: Sequence[Path], seed: int | None) -> dict[str, Any]:
    sources = [{"name": Path(p).name, "sha256": sha256(Path(p))} for p in inputs]
    command, folder = running_command.get() or ("", "")
    ancestors: dict[str, dict[str, Any]] = {}
    for path, source in zip(inputs, sources, strict=True):
        own, earlier = read_record(Path(path))
        ancestors |= earlier
        if own is not None:
            ancestors[source["sha256"]] = own
    return {
        "lunargr_version": version("lunargr"),
        "history": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%SZ} {command or 'lunargr ' + stage}",
        "command": command,
        "folder": folder,
        "config": json.dumps(config, default=str, sort_keys=True),
        "inputs": json.dumps(sources),
        "seed": np.int64(-1 if seed is None else seed),
        "provenance": json.dumps(ancestors, sort_keys=True),
    }


def read_record(path: Path) -> tuple[dict[str, Any] | None, dict[str, dict[str, Any]]]:
    """An artefact's own record (None for other files) and, by SHA-256, those of all that it descends from."""
    digests: list[tuple[str, str]] = []
    try:
        if not (path.is_file() and h5py.is_hdf5(path)):
            return _read_raster(path)
        with open_hdf5(path) as file:
            if is_foreign(file):
                return None, {}
            root = dict(file.attrs.items())
            if any_text(root["lunargr_schema"]) == "scene" and "sha256" in file and "camera_sha256" in file:
                images, cameras = ([any_text(d) for d in file[k][...]] for k in ("sha256", "camera_sha256"))
                digests = list(zip(images, cameras, strict=True))
    except (OSError, RuntimeError, TypeError, ValueError, ArtefactError):
        return None, {}  # whoever opens it says what is wrong
    record, ancestors = _unpack(root, path)
    if digests:
        record["images"] = {"count": len(digests), "sha256": combine_digests(d for pair in digests for d in pair if d)}
    return record, ancestors


def _read_raster(path: Path) -> tuple[dict[str, Any] | None, dict[str, dict[str, Any]]]:
    """The record of a raster or another file: a GeoTIFF or EXR may hold it, others have it in SIDECAR beside them."""
    try:
        text = read_raster(path).record if raster_kind(path) else ""
    except ArtefactError:
        text = ""
    if not text:
        return _read_sidecar(path), {}
    found = parse_json(text, f"{path}: its record")
    record, ancestors = (found.get(k) if isinstance(found, dict) else None for k in ("record", "provenance"))
    return _checked(path, record, ancestors)


def _unpack(root: Mapping[str, Any], path: object) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The record in an artefact's root attributes, and those of its ancestors by SHA-256. Raises ArtefactError."""
    record = {
        "schema": any_text(root["lunargr_schema"]),
        "history": any_text(root.get("history", "")),
        "command": any_text(root.get("command", "")),
        "folder": any_text(root.get("folder", "")),
        "version": any_text(root.get("lunargr_version", "")),
        "seed": _whole(root.get("seed", -1)),
        "config": _parse(path, root, "config", "{}"),
        "inputs": _parse(path, root, "inputs", "[]"),
    }
    return _checked(path, record, _parse(path, root, "provenance", "{}"))


def _checked(path: object, record: Any, ancestors: Any) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """A record and those of its ancestors, if :func:`chain` can follow them. Raises ArtefactError."""
    if not (_is_record(record) and isinstance(ancestors, dict) and all(_is_record(r) for r in ancestors.values())):
        raise ArtefactError(
            f"{path}: expected records of the files it descends from in 'inputs' and 'provenance', found something else; "
            f"write it again."
        )
    return record, ancestors


def _parse(path: object, root: Mapping[str, Any], name: str, absent: str) -> Any:
    return parse_json(any_text(root.get(name, absent)), f"{path}: root attribute '{name}'")


def record_of(file: h5py.File) -> Record:
    """The record of an open artefact. Raises ArtefactError."""
    return _unpack(dict(file.attrs), file.filename)[0]


def _whole(value: Any) -> int | None:
    try:
        return int(value)
    except (OverflowError, TypeError, ValueError):
        return None


def _is_record(record: Any) -> bool:
    """Whether :func:`chain` and ``lunargr replay`` can follow it."""
    if not isinstance(record, dict):
        return False
    inputs, images, made = record.get("inputs"), record.get("images"), record.get("made_images", "")
    keys = ("schema", "history", "command", "folder", "version")
    return (
        all(isinstance(record.get(k), str) for k in keys)
        and isinstance(record.get("seed"), int)
        and isinstance(record.get("config"), dict)
        and isinstance(inputs, list)
        and all(
            isinstance(i, dict) and isinstance(i.get("name"), str) and isinstance(i.get("sha256"), str) for i in inputs
        )
        and (images is None or _is_images(images))
        and isinstance(made, str)
    )


def _is_images(images: Any) -> bool:
    return isinstance(images, dict) and isinstance(images.get("count"), int) and isinstance(images.get("sha256"), str)


def combine_digests(digests: Iterable[str]) -> str:
    """One SHA-256 for many files, of theirs: what ``sha256sum FILES | cut -c 1-64 | sha256sum`` prints."""
    return hashlib.sha256("".join(f"{digest}\n" for digest in digests).encode()).hexdigest()


def folder_record(
    stage: str, config: Mapping[str, Any], seed: int, files: Sequence[Path], images: Sequence[Path]
) -> str:
    """What SIDECAR holds in a folder of rasters and tables: their record, and the hash of each of these files."""
    record, _ = _unpack({"lunargr_schema": stage} | _describe(stage, config, [], seed), "the run")
    record |= {"config": config, "made_images": combine_digests(sha256(path) for path in images)}
    made = {path.name: sha256(path) for path in (*files, *images)}
    return json.dumps({"record": record, "files": made}, indent=1, default=str) + "\n"


def _read_sidecar(path: Path) -> dict[str, Any] | None:
    try:
        found = read_json(path.parent / SIDECAR, "the record of this folder's files")
        good = found["files"].get(path.name) == sha256(path) and _is_record(found["record"])
        return found["record"] if good else None
    except (LunargrError, OSError, KeyError, TypeError, AttributeError):
        return None


@dataclass(frozen=True)
class Step:
    """One file of a chain. ``record`` is None for files that no recorded command made: the user's own."""

    name: str
    sha256: str
    record: dict[str, Any] | None


def chain(path: Path) -> list[Step]:
    """Everything that an artefact descends from, inputs before what was made of them, and last the artefact itself.

    Its own SHA-256 is left empty: nobody needs it, and the file may be large.
    """
    own, ancestors = read_record(path)
    makers = {r["made_images"]: r for r in ancestors.values() if "made_images" in r}
    steps: list[Step] = []
    seen: set[str] = set()
    # Steps to visit, the next one last; one that was visited already follows what it was made from.
    waiting = [(step, False) for step in reversed(_sources(own, makers, ancestors))]
    while waiting:
        step, visited = waiting.pop()
        if visited:
            steps.append(step)
        elif step.sha256 not in seen:
            seen.add(step.sha256)
            waiting.append((step, True))
            waiting += [(source, False) for source in reversed(_sources(step.record, makers, ancestors))]
    return [*steps, Step(path.name, "", own)]


def _sources(record: Record | None, makers: Mapping[Any, Record], ancestors: Mapping[str, Record]) -> list[Step]:
    """What a record says that its file was made from. makers : of images, by their digest; ancestors : by SHA-256"""
    if record is None:
        return []
    found = [Step(i["name"], i["sha256"], ancestors.get(i["sha256"])) for i in record["inputs"]]
    if images := record.get("images"):
        name = f"{images['count']} image{'s' if images['count'] != 1 else ''}"
        found.append(Step(name, images["sha256"], makers.get(images["sha256"])))
    return found
