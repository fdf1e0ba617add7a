"""Opening HDF5 files, and writing them whole or not at all, whatever the HDF5 library does where a disk is full."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py

from schemas.errors import ArtefactError, ConfigError, InputError
from schemas.files.outputs import atomic_path, is_full_disk
from schemas.files.references import check_hdf5
from schemas.files.user_files import check_file


def silence_hdf5() -> None:
    """Keep the HDF5 C library from printing its own error stack: the user gets one line from us.

    After a full disk every HDF5 object fails once more when it is released, where no caller can catch it, and Cython
    reports that through both hooks of ``sys``. These reports, and no others, are kept from the terminal and collected
    in ``release_errors``: what an object still held was not written, and the file must not become an artefact.
    """
    h5py._errors.silence_errors()
    if sys.excepthook is not _except_h5py_release:
        _hooks.append((sys.excepthook, sys.unraisablehook))
        sys.excepthook, sys.unraisablehook = _except_h5py_release, _except_h5py_unraisable


def open_hdf5(path: Path) -> h5py.File:
    """An HDF5 file for reading, which refers to nothing that it may not. Raises ArtefactError."""
    silence_hdf5()
    check_file(path, "an HDF5 file", ArtefactError)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        damaged = h5py.is_hdf5(path) or "truncated" in str(error)
        kind = "a damaged or truncated HDF5 file" if damaged else "another kind of file"
        raise ArtefactError(f"{path}: expected an HDF5 artefact, found {kind}; write it again.") from None
    try:
        check_hdf5(path, file)
    except BaseException:
        file.close()
        raise
    return file


@contextlib.contextmanager
def whole_hdf5(path: Path, check: Callable[[Path], None] = lambda partial: None) -> Iterator[h5py.File]:
    """A new HDF5 file, open for writing; it gets its name when the block ends well, and is gone when it does not.

    check : of the finished file under its temporary name. Raises InputError where the disk is full or fails, ConfigError
    for a place that cannot be written.
    """
    silence_hdf5()
    before = len(release_errors)
    with atomic_path(path) as partial:
        try:
            file = h5py.File(partial, "w", track_order=True, libver=("earliest", "v110"))
        except OSError as error:
            if is_full_disk(error):
                raise
            raise ConfigError(f"{path}: cannot be written ({error}); choose another `output`.") from None
        try:
            yield file
            _flush(path, file, before)
        except BaseException as error:
            if is_full_disk(
                error
            ):  # give back the room that the file took: HDF5 can then close without failing once more
                os.truncate(partial, 0)
            _close(file, before)
            raise
        if late := _close(file, before):
            raise _not_whole(path, late)
        check(partial)


def _flush(path: Path, file: h5py.File, before: int) -> None:
    """Write everything that HDF5 still holds; raises what went wrong, now or when an object was released."""
    found: BaseException | None = None
    if len(release_errors) > before:
        found = release_errors[before]
    else:
        try:
            file.flush()
        except (OSError, RuntimeError) as error:
            found = error
    if found is not None:
        raise found if is_full_disk(found) else _not_whole(path, found)


def _close(file: h5py.File, before: int) -> BaseException | None:
    """Close the file; returns what went wrong."""
    if len(release_errors) > before:
        # HDF5 would follow a pointer into what it failed to release, and take the process down.
        abandoned.append(file)
        return release_errors[before]
    try:
        file.close()
    except (OSError, RuntimeError) as error:
        abandoned.append(file)
        return error
    return None


def _not_whole(path: Path, error: BaseException) -> InputError:
    return InputError(
        f"{path}: cannot be written whole ({error}); nothing half-written is left. "
        "Look after the disk and run the command again."
    )


abandoned: list[Any] = []  # what HDF5 must never release

release_errors: list[BaseException] = []  # of HDF5 objects that could not write what they held when they were released
_hooks: list[tuple[Callable[..., Any], Callable[[Any], Any]]] = []


def _is_release(trace: TracebackType | None) -> bool:
    """Whether a traceback comes from h5py releasing an object."""
    return trace is not None and trace.tb_frame.f_code.co_filename.endswith("h5py/_objects.pyx")


def _except_h5py_release(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if _is_release(trace):
        release_errors.append(error)
    else:
        _hooks[-1][0](kind, error, trace)


def _except_h5py_unraisable(unraisable: Any) -> None:
    if _is_release(unraisable.exc_traceback):
        release_errors.append(unraisable.exc_value or OSError("HDF5 could not close an object"))
    else:
        _hooks[-1][1](unraisable)
