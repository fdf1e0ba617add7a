"""The settings of ingest."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """gsd : m, None for the DEM's own; crop : px; block : px, edge of what is worked on at a time; skip_outside : leave
    out images beside the DEM instead of refusing them; trust_table : take Suns, altitudes and views that contradict the
    images' times or an orbiter's; shard : index and count
    """

    gsd: float | None = None
    crop: int = 128
    body: str = "moon"
    block: int = 1024
    skip_outside: bool = False
    trust_table: bool = False
    shard: tuple[int, int] = (0, 1)
