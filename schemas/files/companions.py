"""Files that belong to an output, such as the GeoTIFF beside a map: a run that ends before the output is whole leaves none.

Each is noted in the output's lock before it gets its name. Whoever lets go of the lock looks there, and so does whoever
finds it as a killed run's.
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
    """Whose companions are being written."""
    return _output.get()


def note_companion(lock: Path, path: Path, partial: Path) -> None:
    """Write down, in its output's lock, that ``partial`` is about to get the name ``path``, unless it replaces a file."""
    if path.exists() or not lock.exists():
        return
    with open(lock, "a") as stream:
        stream.write("\n" + json.dumps({"file": os.path.abspath(path), "made": _identity(partial)}))


def remove_companions(noted: str, output: Path) -> None:
    """What the text of a lock notes, where the output is absent; not what somebody has put in its place since."""
    if output.exists():
        return
    for line in noted.splitlines()[1:]:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            entry = json.loads(line)
            path = Path(entry["file"])
            if _identity(path) == entry["made"]:
                path.unlink()


def _identity(path: Path) -> list[int]:
    """What a file keeps when it is renamed."""
    found = path.stat()
    return [found.st_ino, found.st_size, found.st_mtime_ns]
