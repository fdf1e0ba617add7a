"""Errors of the HDF5 library: kept from the terminal, and collected where no caller can catch them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any

import h5py
import numpy as np

# For unknown values where HDF5's scale-offset filter keeps some decimals, which cannot be NaN: netCDF's default fill.
UNKNOWN = np.float32(9.969209968386869e36)


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
