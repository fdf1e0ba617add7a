"""A map that is written once more, with what the photographs add to it."""

from __future__ import annotations

from typing import Any

import h5py

from schemas import SVBRDF, ArtefactWriter
from schemas.reading import read_strings

ROWS = 256  # rows that are copied at a time

# Root attributes that every artefact makes for itself.
_OWN = (
    "Conventions", "title", "lunargr_schema", "schema_version", "lunargr_version", "history", "config", "inputs", "seed",
    "command", "folder", "provenance", "parts", "shard_rows",
)  # fmt: skip


def sizes_of(source: h5py.File) -> dict[str, int]:
    """Of a map's dimensions."""
    there = [v for v in SVBRDF.variables if v.name in source]
    return {dim: n for v in there for dim, n in zip(v.dims, source[v.name].shape, strict=True)}


def kept_attributes(source: h5py.File) -> dict[str, Any]:
    """What the new map says of itself as the old one did."""
    return {key: value for key, value in source.attrs.items() if key not in _OWN}


def copy_map(source: h5py.File, writer: ArtefactWriter, rows: tuple[int, int], but: tuple[str, ...] = ()) -> None:
    """Every variable of a map but its rows outside of ``rows``, and those that are called as one in ``but``."""
    if "crs" in source:
        source.copy("crs", writer.file, "crs")
    for variable in SVBRDF.variables:
        if variable.name not in source or variable.name in but:
            continue
        if variable.dims[-2:] != ("y", "x"):
            named = variable.dtype == "string"
            writer.write(variable.name, read_strings(source, variable.name) if named else source[variable.name][...])
            continue
        target = writer.dataset(variable.name)
        for row in range(rows[0], rows[1], ROWS):
            part = (..., slice(row, min(rows[1], row + ROWS)), slice(None))
            target[part] = source[variable.name][part]
