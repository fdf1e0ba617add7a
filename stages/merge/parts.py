"""The open parts of one whole, in order, and what they must have in common."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from schemas import ArtefactError, InputError, Schema, open_artefact, read_config, read_kind
from schemas.checks import any_text, parse_json
from schemas.files.inputs import FILE_ATTRIBUTES
from stages.merge.config import Config
from stages.physics.images.table import relative_path

# The dimension along which the shards of a stage are laid end to end; maps are joined by rows instead, and so are scenes
# without images, which are shards of a DEM.
RECORD = {"scene": "frame", "crops": "pair", "pairs": "pair"}
MAPS = ("svbrdf", "normalized")
ROWS = "shard_rows"  # root attribute: first and last row that a part of a map holds
STANDARD = {
    "Conventions", "title", "lunargr_schema", "schema_version", "lunargr_version", "history", "config", "inputs", "seed",
    "command", "folder", "provenance",
}  # fmt: skip
# Root attributes that may differ between the parts of one whole.
_OWN = {"history", "inputs", "config", "lunargr_version", "command", "folder", "provenance"}
# What parts of a DEM join rather than share. A part on nodata has no least and largest elevation.
_JOINED: dict[str, Callable[[Sequence[Any]], Any]] = {
    "elevation_low_m": min,
    "elevation_high_m": max,
    "dem_valid_px": sum,
}


@dataclass(frozen=True)
class Parts:
    """record : dimension along which parts are laid end to end, None where they hold rows of one map"""

    schema: Schema
    paths: list[Path]
    files: list[h5py.File]
    record: str | None

    @property
    def by_rows(self) -> bool:
        """Whether parts are rows of a map, not records."""
        return self.record is None

    @property
    def names(self) -> list[str]:
        """The variables of the whole."""
        return [v.name for v in self.schema.variables if v.name in self.files[0]]

    @property
    def of_one_run(self) -> bool:
        """Whether they are shards of one run, and not whole artefacts such as those of two sites."""
        return len(self.files) > 1 and shard_of(self.files[0])[1] > 1

    def sizes(self) -> dict[str, int]:
        """Of the whole's dimensions."""
        sizes: dict[str, int] = {}
        for variable in self.schema.variables:
            if variable.name in self.files[0]:
                for axis, (dim, size) in enumerate(zip(variable.dims, self.files[0][variable.name].shape, strict=True)):
                    whole = sum(f[variable.name].shape[axis] for f in self.files) if dim == self.record else size
                    sizes.setdefault(dim, whole)
        return {dim: sizes[dim] for dim in self.schema.dims if dim in sizes}

    def attributes(self, output: Path) -> dict[str, Any]:
        """Root attributes that all parts have in common, or that are joined."""
        first = self.files[0].attrs
        common = {k: v for k, v in first.items() if k not in STANDARD and k != ROWS}
        if self.by_rows:
            found = {name: [f.attrs[name] for f in self.files if name in f.attrs] for name in _JOINED}
            common |= {name: _JOINED[name](values) for name, values in found.items() if values}
        if common.get("dem_valid_px") == 0:
            raise InputError(f"{self.paths[0]}: expected elevations in one of the parts, found only nodata in all.")
        for name in FILE_ATTRIBUTES:
            if name in common:
                common[name] = moved(any_text(common[name]), self.paths[0], output)
        return common


def wants_geotiff(paths: Sequence[Path], config: Config) -> bool:
    """Whether the whole gets a GeoTIFF: a map does, if its first part wants one and it is no view of the parts.

    HDF5 cannot read a view of files that this process holds open, and a view is there to save a copy.
    """
    if config.virtual or (schema := read_kind(paths[0])).name not in MAPS:
        return False
    with open_artefact(paths[0], schema) as file:
        return bool(read_config(file).get("geotiff", True))


@contextlib.contextmanager
def open_parts(paths: Sequence[Path]) -> Iterator[Parts]:
    """The parts in the order of their shards. Raises ArtefactError where they are not parts of one whole."""
    schema = read_kind(paths[0])
    if schema.name not in (*RECORD, *MAPS):
        raise ArtefactError(
            f"{paths[0]}: a '{schema.name}' has no parts to merge; parts are: {', '.join((*RECORD, *MAPS))}."
        )
    with contextlib.ExitStack() as stack:
        opened = [(path, stack.enter_context(open_artefact(path, schema))) for path in paths]
        opened.sort(key=lambda part: shard_of(part[1])[0])
        files = [file for _, file in opened]
        record = RECORD.get(schema.name)
        if schema.name == "scene" and all(ROWS in f.attrs for f in files):
            record = None
        parts = Parts(schema, [path for path, _ in opened], files, record)
        _check_complete(parts)
        _check_alike(parts)
        yield parts


def shard_of(file: h5py.File) -> tuple[int, int]:
    """Index and count of the shard that a part is."""
    index, count = read_config(file).get("shard") or (0, 1)
    return int(index), int(count)


def moved(path: str, part: Path, output: Path) -> str:
    """A path that was relative to a part, relative to the output."""
    return relative_path(part.resolve().parent / path, output.resolve().parent) if path else ""


def _check_complete(parts: Parts) -> None:
    found = [shard_of(f) for f in parts.files]
    if {count for _, count in found} == {1}:  # whole artefacts, such as those of two sites: their order is the caller's
        return
    if found != [(k, len(found)) for k in range(len(found))]:
        names = ", ".join(f"{i + 1}/{n} ({p.name})" for p, (i, n) in zip(parts.paths, found, strict=True))
        raise ArtefactError(f"{parts.paths[0]}: expected every shard of one run once, found {names}; name all parts.")


def _check_alike(parts: Parts) -> None:
    first, name = parts.files[0], parts.paths[0]
    for path, file in zip(parts.paths[1:], parts.files[1:], strict=True):
        for key, value in first.attrs.items():
            theirs = file.attrs.get(key)
            if key in FILE_ATTRIBUTES:
                value, theirs = (moved(any_text(v), p, name) for v, p in ((value, name), (theirs, path)))
            if key not in {*_OWN, *_JOINED, ROWS} and any_text(theirs) != any_text(value):
                raise ArtefactError(
                    f"{path}: expected {key} = {value} as in {name}, found {theirs}; these are not parts of one whole."
                )
        missing = {v.name for v in parts.schema.variables if (v.name in first) != (v.name in file)}
        if missing:
            raise ArtefactError(
                f"{path}: expected the variables that {name} has, found a difference in {', '.join(sorted(missing))}; "
                "write both with the same program and options."
            )
        mine, other = read_config(first), read_config(file)
        if any(mine.get(k) != other.get(k) for k in {*mine, *other} - {"shard", "device"}):
            raise ArtefactError(
                f"{path}: expected the options that {name} was made with, found others; run the shard again."
            )
        if parts.of_one_run and _hashes(file, path) != _hashes(first, name):
            raise ArtefactError(
                f"{path}: expected a shard of the files that {name} was made from, found others; run it again."
            )


def _hashes(file: h5py.File, path: Path) -> list[str]:
    """SHA-256 of what a part was made from."""
    inputs = parse_json(any_text(file.attrs.get("inputs", "[]")), f"{path}: root attribute 'inputs'")
    if not isinstance(inputs, list) or not all(isinstance(i, dict) for i in inputs):
        raise ArtefactError(
            f"{path}: expected a list of files in the root attribute 'inputs', found {inputs!r:.40}; run the shard again."
        )
    return sorted(str(i.get("sha256")) for i in inputs)
