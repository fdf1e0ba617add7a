"""What ingest is asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """gsd : m, None for the DEM's own; crop : px; block : px, the unit of streaming."""

    gsd: float | None = None
    crop: int = 128
    body: str = "moon"
    block: int = 1024
    skip_outside: bool = False
    shard: tuple[int, int] = (0, 1)
