"""Files that belong to an output, such as the GeoTIFF beside a map: a run that ends before the output is whole leaves none.

Each is written down in the output's lock before it gets its name. The run that holds the lock reads it there when it
ends, and so does the next run, where a killed one left its lock behind.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

_output: ContextVar[Path | None] = ContextVar("output", default=None)


@contextlib.contextmanager
def companions_of(output: Path | None) -> Iterator[None]:
    """Other files that become whole within this block belong to ``output``, which becomes whole after them."""
    before = _output.set(output)
    try:
        yield
    finally:
        _output.reset(before)


def current_output() -> Path | None:
    """The output whose companions are being written, None outside :func:`companions_of`."""
    return _output.get()


def note_companion(lock: Path, path: Path, partial: Path) -> None:
    """Write into the output's lock that ``partial`` is about to be renamed to ``path``, unless that replaces a file."""
    if path.exists() or not lock.exists():
        return
    with open(lock, "a") as stream:
        stream.write("\n" + json.dumps({"file": os.path.abspath(path), "made": _identity(partial)}))


def remove_companions(noted: str, output: Path) -> None:
    """Remove the companions that a lock's text names, where the output is absent, but no file put in their place."""
    if output.exists():
        return
    for line in noted.splitlines()[1:]:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            entry = json.loads(line)
            path = Path(entry["file"])
            if _identity(path) == entry["made"]:
                path.unlink()


def _identity(path: Path) -> list[int]:
    """Inode, size and time of change, which a file keeps when it is renamed."""
    found = path.stat()
    return [found.st_ino, found.st_size, found.st_mtime_ns]
