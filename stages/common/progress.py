"""Messages and progress of a stage, for its caller."""

from __future__ import annotations

from collections.abc import Callable

Say = Callable[[str], None]  # takes a line of text
Progress = Callable[[int, int, str], None]  # takes how many are done, of how many, and of what


def say_nothing(line: str) -> None:
    """A Say that drops messages."""


def show_nothing(done: int, total: int, what: str) -> None:
    """A Progress that shows none."""
