"""One planted bug."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """file, before, after : what is replaced, by what; tests : of pytest, that fail then; bug : what goes wrong, in words"""

    file: str
    before: str
    after: str
    tests: tuple[str, ...]
    bug: str
