"""The settings of merge."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Config:
    """virtual : leave large variables in the parts, which the output then needs, and write no GeoTIFF; inputs : recorded as what the whole
    was made from, in place of its parts
    """

    virtual: bool = False
    inputs: tuple[Path, ...] | None = None
