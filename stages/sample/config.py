"""The settings of sample."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """crop : px, None for the scene's; count : crops in all (sites with ``stack``); density : crops per km2 of an
    image;
    stack : whether every image of a place is taken; tile_m : edge of a ground tile, None for automatic
    """

    crop: int | None = None
    count: int | None = None
    density: float | None = None
    stack: bool = False
    tile_m: float | None = None
    split: tuple[float, float, float] = (0.8, 0.1, 0.1)
    seed: int = 0
    shard: tuple[int, int] = (0, 1)
    block: int = 1024
