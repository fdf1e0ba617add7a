"""The command line that a run was started with, for those that write it down; light, for those that know it."""

from __future__ import annotations

import shlex
from contextvars import ContextVar
from pathlib import Path

# (command line, folder), None where lunargr is used as a library
said: ContextVar[tuple[str, str] | None] = ContextVar("said", default=None)


def whole_command(command: str, output: Path) -> str:
    """What one run would have been called with, from a shard's command line: no --shard, and the whole's name."""
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
