"""How settings are spelled on the command line. Stages name a setting as its field, in backticks; a user knows the option."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextvars import ContextVar
from typing import get_type_hints

running: ContextVar[Callable[..., None] | None] = ContextVar("running", default=None)  # the command of this process


def option_of(command: Callable[..., None] | None, name: str) -> str:
    """The option that sets a parameter of a command; within Annotated typer keeps the first spelling as the default."""
    hints = get_type_hints(command, include_extras=True) if command else {}
    for mark in getattr(hints.get(name), "__metadata__", ()):
        for spelled in (getattr(mark, "default", None), *(getattr(mark, "param_decls", None) or ())):
            if isinstance(spelled, str) and spelled.startswith("--"):
                return spelled.partition("/")[0]
    return f"--{name.replace('_', '-')}"


def spell(message: str) -> str:
    """A message of a stage with its settings as options of the command that runs."""
    command = running.get()
    return re.sub("`([a-z][a-z0-9_]*)`", lambda found: option_of(command, found[1]), message)
