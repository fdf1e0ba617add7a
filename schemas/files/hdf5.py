"""The HDF5 library's own failures: kept from the terminal, and remembered where no one can catch them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any

import h5py
import numpy as np

# What is not known, in datasets that keep so many decimals: NaN cannot pass HDF5's filter. netCDF's own default fill value.
UNKNOWN = np.float32(9.969209968386869e36)


def silence_hdf5() -> None:
    """Keep the HDF5 C library from printing its own error stack: our one line says it.

    After a full disk every HDF5 object that is let go of fails once more, where no one can catch it, and Cython reports
    that through both hooks of ``sys``: these reports, and no others, are kept from the terminal, and remembered: what an
    object still held was not written, and the file must not become an artefact.
    """
    h5py._errors.silence_errors()
    if sys.excepthook is not _except_h5py_release:
        _hooks.append((sys.excepthook, sys.unraisablehook))
        sys.excepthook, sys.unraisablehook = _except_h5py_release, _except_h5py_unraisable


lost: list[BaseException] = []  # what went wrong where HDF5 let go of objects
_hooks: list[tuple[Callable[..., Any], Callable[[Any], Any]]] = []


def _is_release(trace: TracebackType | None) -> bool:
    """Whether a traceback is that of h5py letting go of an object."""
    return trace is not None and trace.tb_frame.f_code.co_filename.endswith("h5py/_objects.pyx")


def _except_h5py_release(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if _is_release(trace):
        lost.append(error)
    else:
        _hooks[-1][0](kind, error, trace)


def _except_h5py_unraisable(unraisable: Any) -> None:
    if _is_release(unraisable.exc_traceback):
        lost.append(unraisable.exc_value or OSError("HDF5 could not close an object"))
    else:
        _hooks[-1][1](unraisable)
