"""The stage: coefficient maps in a GeoTIFF, converted in strips."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import DatasetReader
from rasterio.windows import Window

from schemas import ConfigError, InputError, atomic_path
from schemas.provenance import raster_record
from schemas.rasters import TIFF_TAG
from stages.common.progress import Progress
from stages.convert import Config
from stages.physics.maps.geotiff import BLOCK, MapTiff
from stages.physics.maps.rasters import open_raster, read_window
from stages.physics.photometry.conventions import Convention, convert_maps, get_convention, model_difference

BLOCK_VALUES = 1 << 23  # values of all bands held at a time, in float64: 64 MB


@dataclass
class Report:
    """What was written: the target's quantities and, in words, what was lost on the way."""

    target: Convention
    losses: list[str]
    valid_pixels: int


def work(source: Path, path: Path, config: Config, progress: Progress) -> Report:
    """See :func:`stages.convert.run`."""
    start, end = get_convention(config.source), get_convention(config.target)
    model_difference(start, end)
    losses: dict[str, str] = {}
    valid = 0
    with open_raster(source, "a GeoTIFF of coefficient maps") as data:
        indices = band_indices(data, start, config.bands)
        with atomic_path(path) as partial, warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            tags = {"CONVENTION": end.name, "RETURNS": end.returns, "CONVERTED_FROM": start.name}
            tags[TIFF_TAG] = raster_record("convert", asdict(config), [source])
            units = [unit for _, unit in end.quantities]
            with MapTiff(partial, data, end.names, tags, units) as target:
                for window in _strips(data, len(indices)):
                    maps = {name: read_window(data, window, band) for name, band in indices.items()}
                    result, lost = convert_maps(maps, start.name, end.name, config.approximate)
                    losses = {**lost, **losses}  # the first example of each
                    stack = np.stack([np.broadcast_to(v, maps[start.names[0]].shape) for v in result.values()])
                    valid += int(np.isfinite(stack).all(axis=0).sum())
                    target.put(int(window.row_off), 0, stack.astype(np.float32))
                    progress(int(window.row_off + window.height), data.height, "convert")
    return Report(end, list(losses.values()), valid)


def band_indices(data: DatasetReader, convention: Convention, names: Sequence[str] | None = None) -> dict[str, int]:
    """Quantity -> 1-based band. Raises InputError or ConfigError with the names that are missing."""
    wanted = ",".join(convention.names)
    found = [(d or "").strip() for d in data.descriptions] if names is None else _named(data, names)
    if not any(found):
        raise InputError(
            f"{data.name}: expected band descriptions {wanted} for {convention.name}, found none; "
            f"name the bands in their order in the file, as in `bands` {wanted}."
        )
    indices = {}
    for name in convention.names:
        bands = [k for k, have in enumerate(found, start=1) if have == name]
        bands = bands or [k for k, have in enumerate(found, start=1) if have.lower() == name.lower()]
        if len(bands) != 1:
            raise InputError(
                f"{data.name}: expected one band '{name}' for {convention.name}, found {len(bands)} among "
                f"'{', '.join(found)}'; name the bands in their order in the file with `bands`."
            )
        indices[name] = bands[0]
    return indices


def _named(data: DatasetReader, names: Sequence[str]) -> list[str]:
    """The user's names by band, '' for bands without one. Raises ConfigError."""
    if not any("=" in name for name in names):
        if len(names) != data.count:
            raise ConfigError(
                f"`bands`: expected {data.count} names for the {data.count} bands of {data.name}, found {len(names)}; "
                "give only those that are wanted as NAME=INDEX."
            )
        return list(names)
    found = [""] * data.count
    for item in names:
        name, _, index = item.partition("=")
        if not index.strip().isdigit() or not 1 <= int(index) <= data.count:
            raise ConfigError(f"`bands`: expected NAME=INDEX with an index from 1 to {data.count}, found '{item}'.")
        found[int(index) - 1] = name.strip()
    return found


def _strips(data: DatasetReader, bands: int) -> Iterator[Window]:
    """Windows of whole rows, a multiple of the output's tile height where that fits the memory."""
    rows = max(1, BLOCK_VALUES // max(1, data.width * bands))
    rows = rows // BLOCK * BLOCK or rows
    for row in range(0, data.height, rows):
        yield Window(0, row, data.width, min(rows, data.height - row))
