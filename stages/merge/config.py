"""What merge is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Config:
    """virtual : large variables stay in the parts, which the output then needs; inputs : what the whole says it was made
    from, in place of its parts
    """

    virtual: bool = False
    inputs: tuple[Path, ...] | None = None
