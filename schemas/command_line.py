"""The command line of the run, which artefacts record. Imports nothing heavy: the command line's own module sets it."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path

from schemas.errors import ConfigError

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


def count_processes() -> tuple[int, int]:
    """How many processes torchrun started, in all and on this machine; (1, 1) without it. Raises ConfigError."""
    counts = []
    for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"):
        text = os.environ.get(name, "1")
        if not (text.isdecimal() and len(text) < 9 and int(text)):
            raise ConfigError(f"{name}: expected a count of processes as torchrun sets it, found '{text}'; unset it.")
        counts.append(int(text))
    return counts[0], min(counts)


def is_first_process() -> bool:
    """Whether this is the process that writes and speaks: under torchrun the first one, otherwise any."""
    return os.environ.get("RANK", "0") == "0"


def output_of(words: Sequence[str]) -> str | None:
    """The output that the words of a command line name, None where they leave it to the command."""
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word in ("-o", "--output"):
            return following
        if word.startswith("--output="):
            return word.removeprefix("--output=")
    return None


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
