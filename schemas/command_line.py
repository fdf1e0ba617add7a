"""The command line that a run was started with, for those that write it down; light, for those that know it."""

from __future__ import annotations

from contextvars import ContextVar

# (command line, folder), None where lunargr is used as a library
said: ContextVar[tuple[str, str] | None] = ContextVar("said", default=None)
