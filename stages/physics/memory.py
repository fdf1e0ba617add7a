"""Freed memory that goes back to the system: what glibc keeps in pieces adds up where work comes in large portions."""

from __future__ import annotations

import contextlib
import ctypes


def return_freed_memory() -> None:
    """Give back the whole pages among the pieces that lie free in glibc's heap; for once a portion, not once a block."""
    with contextlib.suppress(OSError, AttributeError):  # another C library, which has no such call
        ctypes.CDLL(None).malloc_trim(0)
