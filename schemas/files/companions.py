"""Files that belong to an output, such as the GeoTIFF beside a map: a run that ends before the output is whole leaves none.

Each is written down in the run's record (``locks.record_path``) before it gets its name. The run reads the record when
it ends, and so does the next run, where a killed one left it behind.
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


def note_companion(record: Path, path: Path, partial: Path) -> None:
    """Write into the output's record that ``partial`` is about to be renamed to ``path``, unless that replaces a file."""
    if path.exists() or not record.exists():
        return
    with open(record, "a") as stream:
        stream.write(json.dumps({"file": os.path.abspath(path), "made": _identity(partial)}) + "\n")


def remove_companions(noted: str, output: Path) -> None:
    """Remove the companions that a record's text names where the output is absent; files put in their place stay."""
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
