"""The command line of the run, which artefacts record. Imports nothing heavy: the command line's own module sets it."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

# (command line, folder), None where lunargr is used as a library
running_command: ContextVar[tuple[str, str] | None] = ContextVar("running_command", default=None)


@contextlib.contextmanager
def recording(command: tuple[str, str] | None) -> Iterator[None]:
    """Within this block artefacts record this (command line, folder) as what made them."""
    token = running_command.set(command)
    try:
        yield
    finally:
        running_command.reset(token)


def whole_command(command: str, output: Path) -> str:
    """The command line of one whole run, from that of a shard: without --shard, and with the whole's ``output``."""
    words, kept, named, skip = shlex.split(command), [], False, False
    for word in words:
        name, equals, _ = word.partition("=")
        if skip:
            skip = False
        elif name == "--shard":
            skip = not equals
        elif name in ("-o", "--output"):
            kept += ["-o", str(output)]
            skip, named = not equals, True
        else:
            kept.append(word)
    if words and not named:
        kept += ["-o", str(output)]
    return shlex.join(kept)
