"""How a stage tells whoever started it what it does and how far it is."""

from __future__ import annotations

from collections.abc import Callable

Say = Callable[[str], None]  # a line for the person who waits
Progress = Callable[[int, int, str], None]  # how many are done, of how many, of what


def say_nothing(line: str) -> None:
    """For callers who want no messages."""


def show_nothing(done: int, total: int, what: str) -> None:
    """For callers who want no progress."""
