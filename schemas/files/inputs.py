"""The files that a run reads, under every name that they have: no output may replace one of them.

These are the files that the user names, and the files that those name in turn: the images and camera models of an image
table, of a scene or of crops, the DEM of a scene, the scene of crops, the parts behind a virtual artefact, the sources of a VRT, the label
of an image.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import stat
from collections.abc import Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError, InputError, LunargrError
from schemas.files.locks import check_length, is_beside

TABLES = (".csv", ".json")
FILE_COLUMNS = ("path", "camera", "angles")
FILE_ATTRIBUTES = ("scene", "elevation_source")
_UNREADABLE = (LunargrError, OSError, RuntimeError, ValueError, KeyError, TypeError)  # said when the file is opened


class Inputs:
    """A set of files, and of all files that they name in turn. Raises InputError for a link that leads to itself."""

    def __init__(self, paths: Iterable[Path] = ()) -> None:
        self._files: dict[Hashable, Path] = {}
        self._folders: dict[str, dict[str, Path]] = {}
        waiting = [Path(p) for p in paths]
        while waiting:
            path = waiting.pop()
            if _location(path) in self._files:
                continue
            self.note(path)
            waiting += files_named_in(path)

    @property
    def paths(self) -> set[Path]:
        """The files, each under a name that it was given."""
        return set(self._files.values())

    def note(self, path: Path) -> None:
        """Add one file, without what it names."""
        for name in _identities(path):
            self._files.setdefault(name, path)
            if isinstance(name, str):
                folder, _, base = name.rpartition(os.sep)
                self._folders.setdefault(folder, {})[base] = path

    def find(self, output: Path) -> Path | None:
        """The input that is this file: of the same path, behind the same link, or the same file under another name."""
        try:
            return next((self._files[name] for name in _identities(output) if name in self._files), None)
        except InputError:
            return None  # a link that leads to itself is no input; the error comes when it is written

    def clash(self, output: Path) -> Path | None:
        """The input that writing ``output`` would replace or remove: this file, or its lock, temporary file or part."""
        if (found := self.find(output)) is not None:
            return found
        folder, _, name = _location(output).rpartition(os.sep)
        for base, path in self._folders.get(folder, {}).items():
            if is_beside(name, base):
                return path
        parts = f"{_location(output)}.parts"
        for place, inside in self._folders.items():
            if place == parts or place.startswith(parts + os.sep):
                return next(iter(inside.values()))
        return None


def check_input(path: Path) -> None:
    """Refuse a file that is not there, before a stage is imported, which takes seconds. Raises ConfigError, InputError."""
    name = os.fspath(path)
    if "\0" in name or not name:
        raise ConfigError(f"'{name}': expected the name of a file; check the options.")
    check_length(path)
    if ":" in name or name.startswith("/vsi"):  # GDAL also reads NETCDF:file.h5:variable and /vsizip/maps.zip/map.tif
        return
    try:
        os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path or run the stage that writes it.") from None
    except (OSError, ValueError):  # of which the stage says more
        return


def _location(path: Path) -> str:
    """The absolute path of a name, with links among its folders followed; the name itself may be a link."""
    path = Path(os.path.abspath(path))
    return os.path.join(os.path.realpath(path.parent), path.name)


def _identities(path: Path) -> list[Hashable]:
    """What identifies a file: its location, where its links lead, and its inode. Raises InputError."""
    names: list[Hashable] = [_location(path), os.path.realpath(path)]
    try:
        state = os.stat(path)
        names.append((state.st_dev, state.st_ino))
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise InputError(f"{path}: a symbolic link that leads to itself; name the file.") from None
    return names


def files_named_in(path: Path) -> tuple[Path, ...]:
    """The other files that a file depends on; none where it cannot be read, which is reported when it is opened."""
    try:
        state = path.stat()
    except OSError:
        return tuple(_in_raster(path)) if ":" in path.name else ()  # GDAL has names like NETCDF:file.nc:variable
    return _read_names(path, state.st_size, state.st_mtime_ns) if stat.S_ISREG(state.st_mode) else ()


@functools.lru_cache(maxsize=1 << 17)
def _read_names(path: Path, size: int, modified: int) -> tuple[Path, ...]:
    """Read once while a file stays as it is: a table may name thousands, and every output is checked."""
    if path.suffix.lower() in TABLES:
        return tuple(_in_table(path))
    return tuple(_in_artefact(path) if _is_hdf5(path) else _in_raster(path))


def _in_table(path: Path) -> Iterator[Path]:
    from schemas.files.user_files import parse_csv, read_json, read_text

    what = "an image table"
    try:
        is_json = path.suffix.lower() == ".json"
        rows: Any = read_json(path, what) if is_json else parse_csv(path, read_text(path, what), what)[1]
    except LunargrError:
        return
    rows = rows.get("images") if isinstance(rows, Mapping) else rows
    for row in rows if isinstance(rows, list) else ():
        for column in FILE_COLUMNS:
            name = row.get(column) if isinstance(row, Mapping) else None
            if isinstance(name, str) and name.strip() and "\0" not in name:
                yield path.parent / name.strip()


def _is_hdf5(path: Path) -> bool:
    import h5py

    try:
        return bool(h5py.is_hdf5(path))
    except (OSError, ValueError):
        return False


def _in_artefact(path: Path) -> Iterator[Path]:
    import h5py

    from schemas.checks import any_text
    from schemas.files.hdf5 import open_hdf5

    named: list[str] = []
    with contextlib.suppress(*_UNREADABLE), open_hdf5(path) as file:
        named += [any_text(file.attrs[name]) for name in FILE_ATTRIBUTES if name in file.attrs]
        for column in FILE_COLUMNS:
            data = file.get(column)
            if isinstance(data, h5py.Dataset) and data.ndim == 1:
                named += map(any_text, data[...])
        for data in file.values():
            if isinstance(data, h5py.Dataset) and data.is_virtual:
                named += {part.file_name for part in data.virtual_sources()}
    folder = Path(os.path.realpath(path)).parent
    for name in named:
        if name and "\0" not in name:
            yield folder / name


def _in_raster(path: Path) -> Iterator[Path]:
    from rasterio.errors import RasterioError

    from schemas.files.references import open_raster_file

    with contextlib.suppress(RasterioError, *_UNREADABLE), open_raster_file(path) as data:
        for name in data.files:
            yield Path(name)
