"""The files of a command line: what it reads and what it writes, told from the types of a command's parameters.

A parameter of type Path that does not carry :class:`Writes` is an input. No run replaces an input, so that a new command's
output which somebody forgot to mark cannot be written at all.
"""

from __future__ import annotations

import enum
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

from schemas.errors import ConfigError, InputError
from schemas.files.locks import LONGEST_NAME
from schemas.files.outputs import Target, check_apart, check_folder, check_name, check_outputs, protect

LONGEST_PATH = 4096  # bytes, as Linux has it


class Writes(enum.Enum):
    """What a command makes of a path: a file, a folder of files, or either, as other options say."""

    FILE = "file"
    FOLDER = "folder"
    EITHER = "either"


@dataclass
class Files:
    """The files of one call. ``written`` holds (parameter, path, kind)."""

    read: list[Path] = field(default_factory=list)
    written: list[tuple[str, Path, Writes]] = field(default_factory=list)


def files_of(command: Callable[..., None], arguments: Mapping[str, Any]) -> Files:
    """What a call of ``command`` reads and writes."""
    files, hints = Files(), get_type_hints(command, include_extras=True)
    for name, value in arguments.items():
        paths = [p for p in (value if isinstance(value, list | tuple) else [value]) if isinstance(p, Path)]
        marks = getattr(hints.get(name), "__metadata__", ())
        kind = next((mark for mark in marks if isinstance(mark, Writes)), None)
        if kind is None:
            files.read += paths
        else:
            files.written += [(name, path, kind) for path in paths]
    return files


@contextmanager
def guarded(
    command: Callable[..., None], options: Mapping[str, Any], lock: AbstractContextManager[None] = nullcontext()
) -> Iterator[None]:
    """Refuse, before anything is done, outputs that cannot be written; within the block no input is replaced.

    options : the command's parameters by name; lock : of the output, held within the block. Raises ConfigError, InputError.
    """
    files = files_of(command, options)
    for path in (*files.read, *(path for _, path, _ in files.written)):
        _check_name(path)
    if not files.written:
        yield
        return
    overwrite = bool(options.get("overwrite"))
    replace = overwrite or bool(options.get("resume"))  # what is resumed, stages say
    for name, path, kind in files.written:
        if kind is Writes.FILE and not path.name:
            raise ConfigError(f"{path}: expected a file name, found a folder; name the file in `{name}`.")
        check_name(Target(path, name))
    with protect(files.read, overwrite):
        check_apart([Target(path, name) for name, path, _ in files.written])
        with lock:  # whoever gets it tidies up after a killed run
            check_outputs(
                (Target(p, name) for name, p, kind in files.written if kind is Writes.FILE), overwrite=replace
            )
            for name, path, kind in files.written:
                if kind is Writes.FOLDER:
                    check_folder(Target(path, name))
            for path in files.read:
                _check_there(path)
            yield


def _check_there(path: Path) -> None:
    """Refuse a missing input before a stage is imported, which takes seconds. Raises InputError."""
    address = os.fspath(path)
    if ":" in address or address.startswith(
        "/vsi"
    ):  # GDAL also reads NETCDF:file.h5:variable and /vsizip/maps.zip/map.tif
        return
    try:
        os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path or run the stage that writes it.") from None
    except (OSError, ValueError):  # of which the stage says more
        return


def _check_name(path: Path) -> None:
    """Refuse names that no file has; GDAL, HDF5 and JSON keep names as UTF-8. Raises ConfigError."""
    name = os.fspath(path)
    if "\0" in name or not name:
        raise ConfigError(f"'{name}': expected the name of a file; check the options.")
    try:
        longest = max(len(part.encode()) for part in name.split(os.sep))
    except UnicodeEncodeError:
        raise ConfigError(f"{name}: expected a name in UTF-8, found other bytes; rename the file.") from None
    if longest > LONGEST_NAME or len(name.encode()) >= LONGEST_PATH:
        raise ConfigError(f"{name}: expected a name of at most {LONGEST_NAME} bytes, found a longer one; shorten it.")
