"""merge: join the parts that shards of one stage wrote into the artefact that one run would have written."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas import (
    ArtefactError,
    ArtefactWriter,
    Schema,
    atomic_path,
    check_output,
    open_artefact,
    read_config,
    read_kind,
    read_strings,
)
from schemas.files.companions import companions_of
from schemas.files.outputs import Target, check_outputs
from schemas.provenance import whole_command
from stages.physics.images.table import relative_path
from stages.physics.maps.geotiff import write_geotiff
from stages.physics.maps.grid import read_grid

Progress = Callable[[int, int, str], None]

# The dimension along which the shards of a stage are laid end to end; maps are joined by rows instead, and so are scenes
# without images, which are shards of a DEM.
RECORD = {"scene": "frame", "crops": "pair", "pairs": "pair"}
MAPS = ("svbrdf",)
PATHS = ("path", "camera")
STANDARD = {
    "Conventions", "title", "lunargr_schema", "schema_version", "lunargr_version", "history", "config", "inputs", "seed",
    "command", "folder", "provenance",
}  # fmt: skip
# Root attributes that may differ between the parts of one whole.
_OWN = {"history", "inputs", "config", "lunargr_version", "command", "folder", "provenance"}
# What is joined rather than compared: extremes, counts, and the rows that a part holds.
_JOINED: dict[str, Callable[[Sequence[Any]], Any]] = {
    "elevation_low_m": min,
    "elevation_high_m": max,
    "dem_valid_px": sum,
}
ROWS = "shard_rows"
BUFFER = 1 << 26  # bytes that are copied at a time


def run(
    parts: Sequence[Path],
    output: Path,
    overwrite: bool = False,
    progress: Progress | None = None,
    virtual: bool = False,
    inputs: Sequence[Path] | None = None,
    geotiff: Path | None = None,
) -> Schema:
    """Join ``parts``, in the order of their shards. Raises ArtefactError where they are not parts of one whole.

    virtual : large variables stay in the parts, which the output then needs; inputs : what the whole says it was made
    from, in place of its parts; geotiff : where the GeoTIFF of a map goes (if its parts want one), beside the
    output where None
    """
    schema = read_kind(parts[0])
    if schema.name not in (*RECORD, *MAPS):
        raise ArtefactError(
            f"{parts[0]}: a '{schema.name}' has no parts to merge; parts are: {', '.join((*RECORD, *MAPS))}."
        )
    tiff = geotiff or output.with_suffix(".tif")
    with contextlib.ExitStack() as stack:
        files = [stack.enter_context(open_artefact(p, schema)) for p in parts]
        order = sorted(range(len(files)), key=lambda k: _shard(files[k])[0])
        parts, files = [parts[k] for k in order], [files[k] for k in order]
        _check_complete(parts, files)
        _check_alike(parts, files)
        record = RECORD.get(schema.name)
        if schema.name == "scene" and len(files) > 1 and not any(f["frame_window"].shape[0] for f in files):
            record = None
        by_rows = record is None
        sizes = _sizes(schema, files, record)
        attributes = {k: v for k, v in files[0].attrs.items() if k not in STANDARD and k != ROWS}
        for name, join in _JOINED.items():
            if name in attributes and by_rows:
                attributes[name] = join([f.attrs[name] for f in files])
        if "scene" in attributes:
            attributes["scene"] = _moved(str(attributes["scene"]), parts[0], output)
        config = read_config(files[0]) | {"shard": [0, 1]}
        as_geotiff = schema.name in MAPS and config.get("geotiff", True)
        # a run's own parts lie in the folder beside its output, and go with it
        foreign = [part for part in parts if f"{output.name}.parts" not in part.parts]
        if as_geotiff:
            check_outputs([Target(output), Target(tiff, what=f"the GeoTIFF of {output.name}")], foreign, overwrite)
        if inputs is None and len(files) > 1 and _shard(files[0])[1] > 1:
            # shards of one run: the whole is what that run in one piece would have made, from the same inputs
            attributes |= {k: files[0].attrs[k] for k in ("inputs", "provenance", "folder") if k in files[0].attrs}
            attributes["command"] = whole_command(str(files[0].attrs.get("command", "")), output)
            attributes["parts"] = json.dumps([part.name for part in parts])
            check_output(output, foreign, overwrite)
            inputs = []
        seed = int(files[0].attrs.get("seed", -1))
        with ArtefactWriter(
            output,
            schema,
            sizes,
            config=config,
            inputs=list(parts if inputs is None else inputs),
            seed=None if seed < 0 else seed,
            attributes=attributes,
            overwrite=overwrite,
        ) as writer:
            if "crs" in files[0]:
                files[0].copy("crs", writer.file, "crs")
            names = [v.name for v in schema.variables if v.name in files[0]]
            for number, name in enumerate(names):
                if progress:
                    progress(number, len(names), f"merging {name}")
                dims = schema[name].dims
                if virtual and _worth_a_view(files, name):
                    if record in dims:
                        writer.link(name, _end_to_end(files, name, dims.index(record)))
                        continue
                    if by_rows and dims[-2:] == ("y", "x") and all(ROWS in f.attrs for f in files):
                        writer.link(name, _own_rows(files, name))
                        continue
                    if not by_rows and files[0][name].is_virtual:
                        writer.link(name, [((slice(None),) * len(dims), files[0][name], (slice(None),) * len(dims))])
                        continue
                unit = files[0][name].attrs.get("units")
                target = writer.dataset(
                    name,
                    unit=str(unit) if unit is not None and schema[name].unit_choices else None,
                    decimals=_decimals(files, name),
                )
                if record in dims:
                    _concatenate(files, name, target, dims.index(record))
                elif dims[-2:] == ("y", "x") and by_rows:
                    _overlay(files, name, target)
                elif dims[-2:] == ("y", "x"):
                    _copy_rows(files[0][name], target, 0, target.shape[-2])
                elif name in PATHS:
                    target[...] = np.array(
                        [_moved(v, parts[0], output) for v in read_strings(files[0], name)], dtype=object
                    )
                elif target.shape == () or 0 not in target.shape:
                    target[...] = _known(files, name)
            if "path" in names and record == "frame":
                _move_paths(files, parts, writer.file, output)
            if as_geotiff:
                with companions_of(output), atomic_path(tiff) as partial:
                    write_geotiff(partial, writer.file, read_grid(writer.file, output))
            if progress:
                progress(len(names), len(names), "merging")
    return schema


def _moved(path: str, part: Path, output: Path) -> str:
    """A path that was relative to a part, relative to the output."""
    return relative_path(part.resolve().parent / path, output.resolve().parent) if path else ""


def _move_paths(files: Sequence[h5py.File], parts: Sequence[Path], merged: h5py.File, output: Path) -> None:
    for name in PATHS:
        moved = [
            _moved(v, part, output) for file, part in zip(files, parts, strict=True) for v in read_strings(file, name)
        ]
        merged[name][...] = np.array(moved, dtype=object)


def _shard(file: h5py.File) -> tuple[int, int]:
    index, count = read_config(file).get("shard") or (0, 1)
    return int(index), int(count)


def _check_complete(parts: Sequence[Path], files: Sequence[h5py.File]) -> None:
    found = [_shard(f) for f in files]
    counts = {count for _, count in found}
    if counts == {1}:  # parts made without --shard, such as two sites: their order is the caller's
        return
    expected = [(k, len(files)) for k in range(len(files))]
    if found != expected:
        names = ", ".join(f"{i + 1}/{n} ({p.name})" for p, (i, n) in zip(parts, found, strict=True))
        raise ArtefactError(f"{parts[0]}: expected every shard of one run once, found {names}; name all parts.")


def _check_alike(parts: Sequence[Path], files: Sequence[h5py.File]) -> None:
    first = files[0]
    for path, file in zip(parts[1:], files[1:], strict=True):
        for key, value in first.attrs.items():
            if key not in {*_OWN, *_JOINED, ROWS} and str(file.attrs.get(key)) != str(value):
                raise ArtefactError(
                    f"{path}: expected {key} = {value} as in {parts[0]}, found {file.attrs.get(key)}; these are not parts of one whole."
                )
        mine, other = (json.loads(str(f.attrs["config"])) for f in (first, file))
        if any(mine.get(k) != other.get(k) for k in {*mine, *other} - {"shard", "device"}):
            raise ArtefactError(
                f"{path}: expected the options that {parts[0]} was made with, found others; run the shard again."
            )


def _sizes(schema: Schema, files: Sequence[h5py.File], record: str | None) -> dict[str, int]:
    sizes: dict[str, int] = {}
    for variable in schema.variables:
        if variable.name in files[0]:
            for dim, size in zip(variable.dims, files[0][variable.name].shape, strict=True):
                whole = size
                if dim == record:
                    whole = sum(f[variable.name].shape[variable.dims.index(dim)] for f in files)
                sizes.setdefault(dim, whole)
    return {dim: sizes[dim] for dim in schema.dims if dim in sizes}


def _worth_a_view(files: Sequence[h5py.File], name: str) -> bool:
    return files[0][name].ndim >= 2 and any(f[name].size for f in files) and files[0][name].dtype.kind in "iufb"


def _end_to_end(files: Sequence[h5py.File], name: str, axis: int) -> list[Any]:
    place, found = 0, []
    for file in files:
        source, count = file[name], file[name].shape[axis]
        before, after = (slice(None),) * axis, (slice(None),) * (source.ndim - axis - 1)
        if count:
            found.append(((*before, slice(place, place + count), *after), source, (slice(None),) * source.ndim))
        place += count
    return found


def _own_rows(files: Sequence[h5py.File], name: str) -> list[Any]:
    found = []
    for file in files:
        first, last = (int(v) for v in file.attrs[ROWS])
        part = (*(slice(None),) * (file[name].ndim - 2), slice(first, last), slice(None))
        if last > first:
            found.append((part, file[name], part))
    return found


def _decimals(files: Sequence[h5py.File], name: str) -> int | None:
    """Digits after the point that a variable keeps, where all parts keep as many (ArtefactWriter.dataset)."""
    kept = {file[name].scaleoffset for file in files if file[name].size}
    return kept.pop() if len(kept) == 1 and files[0][name].dtype.kind == "f" else None


def _concatenate(files: Sequence[h5py.File], name: str, target: h5py.Dataset, axis: int) -> None:
    place = 0
    for file in files:
        source = file[name]
        if not _move_chunks(source, target, axis, place):
            step = max(1, BUFFER // max(1, source.nbytes // max(1, source.shape[axis])))
            for k in range(0, source.shape[axis], step):
                n = min(step, source.shape[axis] - k)
                key: tuple[Any, ...] = (slice(None),) * axis
                target[(*key, slice(place + k, place + k + n))] = source[(*key, slice(k, k + n))]
        place += source.shape[axis]


def _move_chunks(source: h5py.Dataset, target: h5py.Dataset, axis: int, place: int) -> bool:
    """Copy what is stored, as it is stored, where both files cut the variable alike: masks stay sparse and deflated.

    Chunks that nobody wrote stay unwritten. False where it cannot be done.
    """
    alike = source.chunks is not None and source.chunks == target.chunks and source.dtype == target.dtype
    if not alike or source.chunks[axis] != 1 or source.compression != target.compression:
        return False
    how = [(d.compression_opts, d.shuffle, d.scaleoffset) for d in (source, target)]
    if how[0] != how[1]:
        return False
    offsets: list[tuple[int, ...]] = []
    source.id.chunk_iter(lambda info: offsets.append(info.chunk_offset))
    for offset in offsets:
        mask, stored = source.id.read_direct_chunk(offset)
        moved = (*offset[:axis], offset[axis] + place, *offset[axis + 1 :])
        target.id.write_direct_chunk(moved, stored, mask)
    return True


def _known(files: Sequence[h5py.File], name: str) -> Any:
    """What the parts have in common; NaN where one part knows nothing (an image that it did not register) gives way."""
    values = files[0][name][...]
    for file in files[1:]:
        if values.dtype.kind == "f" and name in file and file[name].shape == values.shape:
            values = np.where(np.isnan(values), file[name][...], values)
    return values


def _overlay(files: Sequence[h5py.File], name: str, target: h5py.Dataset, rows: int = 256) -> None:
    """Each part's own rows; where parts do not say which these are, what any part knows (others hold NaN, or 0)."""
    if all(ROWS in file.attrs for file in files):
        for file in files:
            _copy_rows(file[name], target, *(int(v) for v in file.attrs[ROWS]))
        return
    height = target.shape[-2]
    for first in range(0, height, rows):
        part = (..., slice(first, min(height, first + rows)), slice(None))
        joined = files[0][name][part]
        for file in files[1:]:
            other = file[name][part]
            joined = (
                np.where(np.isnan(joined), other, joined) if joined.dtype.kind == "f" else np.maximum(joined, other)
            )
        target[part] = joined


def _copy_rows(source: h5py.Dataset, target: h5py.Dataset, first: int, last: int, rows: int = 256) -> None:
    for row in range(first - first % rows, last, rows):
        part = (..., slice(max(first, row), min(last, row + rows)), slice(None))
        target[part] = source[part]
