"""Joining the variables of the parts: end to end, row by row, as views of the parts, or copied from one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas import ArtefactWriter, read_strings
from schemas.packing import Packing, read_packing, unpack
from stages.merge.parts import ROWS, Parts, moved

PATHS = ("path", "camera", "angles")
BUFFER = 1 << 26  # bytes that are copied at a time
BLOCK_ROWS = 256  # rows of a map that are copied at a time


def join_variable(parts: Parts, name: str, writer: ArtefactWriter, virtual: bool) -> None:
    """One variable of the whole; ``virtual`` leaves a large one in the parts."""
    files, first = parts.files, parts.files[0]
    dims = parts.schema[name].dims
    by_rows = parts.by_rows and dims[-2:] == ("y", "x")
    along = dims.index(parts.record) if parts.record and parts.record in dims else None
    if virtual and (pieces := _view(parts, name, along, by_rows)):
        writer.link(name, pieces)
        return
    unit = first[name].attrs.get("units")
    target = writer.dataset(
        name,
        unit=str(unit) if unit is not None and parts.schema[name].unit_choices else None,
        packing=_packing(files, name),
    )
    if along is not None:
        _concatenate(files, name, target, along)
    elif by_rows:
        _overlay(files, name, target)
    elif dims[-2:] == ("y", "x"):
        _copy_rows(first[name], target, 0, target.shape[-2])
    elif name not in PATHS and (target.shape == () or 0 not in target.shape):
        target[...] = _common_values(files, name)


def join_paths(parts: Parts, merged: h5py.File, output: Path) -> None:
    """The names of images and cameras, relative to the whole's folder instead of the parts'."""
    sources = list(zip(parts.paths, parts.files, strict=True))
    for name in PATHS:
        if name in merged:
            found = sources if parts.record == "frame" else sources[:1]
            names = [moved(v, path, output) for path, file in found for v in read_strings(file, name)]
            merged[name][...] = np.array(names, dtype=object)


def _view(parts: Parts, name: str, along: int | None, by_rows: bool) -> list[Any]:
    """The pieces of a view, as ArtefactWriter.link takes them; empty where the variable is copied instead."""
    files, source = parts.files, parts.files[0][name]
    if source.ndim < 2 or source.dtype.kind not in "iufb" or not any(f[name].size for f in files):
        return []
    if len({read_packing(f[name]) for f in files}) > 1:
        return []
    if along is not None:
        return _end_to_end(files, name, along)
    if by_rows and all(ROWS in f.attrs for f in files):
        return _own_rows(files, name)
    everything = (slice(None),) * source.ndim
    return [(everything, source, everything)] if source.is_virtual and not parts.by_rows else []


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


def _packing(files: Sequence[h5py.File], name: str) -> Packing | None:
    """How a variable is packed, where all parts are packed alike."""
    kept = {read_packing(file[name]) for file in files}
    return kept.pop() if len(kept) == 1 else None


def _concatenate(files: Sequence[h5py.File], name: str, target: h5py.Dataset, axis: int) -> None:
    place = 0
    for file in files:
        source = file[name]
        if not _move_chunks(source, target, axis, place):
            step = max(1, BUFFER // max(1, source.nbytes // max(1, source.shape[axis])))
            for k in range(0, source.shape[axis], step):
                n = min(step, source.shape[axis] - k)
                key: tuple[Any, ...] = (slice(None),) * axis
                values = source[(*key, slice(k, k + n))]
                same_codes = read_packing(source) == read_packing(target) is not None
                target[(*key, slice(place + k, place + k + n))] = values if same_codes else unpack(source, values)
        place += source.shape[axis]


def _move_chunks(source: h5py.Dataset, target: h5py.Dataset, axis: int, place: int) -> bool:
    """Copy chunks as they are stored, where both files have the same layout; returns whether they have.

    Masks stay deflated, and chunks that were never written stay absent.
    """
    alike = source.chunks is not None and source.chunks == target.chunks and source.dtype == target.dtype
    if not alike or source.chunks[axis] != 1 or source.compression != target.compression:
        return False
    how = [(d.compression_opts, d.shuffle, d.scaleoffset, read_packing(d)) for d in (source, target)]
    if how[0] != how[1]:
        return False
    offsets: list[tuple[int, ...]] = []
    source.id.chunk_iter(lambda info: offsets.append(info.chunk_offset))
    for offset in offsets:
        mask, stored = source.id.read_direct_chunk(offset)
        moved = (*offset[:axis], offset[axis] + place, *offset[axis + 1 :])
        target.id.write_direct_chunk(moved, stored, mask)
    return True


def _common_values(files: Sequence[h5py.File], name: str) -> Any:
    """The values that the parts have in common; where one has NaN (an image that it did not register), another's."""
    values = files[0][name][...]
    for file in files[1:]:
        if values.dtype.kind == "f" and name in file and file[name].shape == values.shape:
            values = np.where(np.isnan(values), file[name][...], values)
    return values


def _overlay(files: Sequence[h5py.File], name: str, target: h5py.Dataset) -> None:
    """Each part's own rows; without ``shard_rows``, whatever part has a value there (the others have NaN, or 0)."""
    if all(ROWS in file.attrs for file in files):
        for file in files:
            _copy_rows(file[name], target, *(int(v) for v in file.attrs[ROWS]))
        return
    height = target.shape[-2]
    for first in range(0, height, BLOCK_ROWS):
        part = (..., slice(first, min(height, first + BLOCK_ROWS)), slice(None))
        joined = files[0][name][part]
        for file in files[1:]:
            other = file[name][part]
            joined = (
                np.where(np.isnan(joined), other, joined) if joined.dtype.kind == "f" else np.maximum(joined, other)
            )
        target[part] = joined


def _copy_rows(source: h5py.Dataset, target: h5py.Dataset, first: int, last: int) -> None:
    for row in range(first - first % BLOCK_ROWS, last, BLOCK_ROWS):
        part = (..., slice(max(first, row), min(last, row + BLOCK_ROWS)), slice(None))
        target[part] = source[part]
