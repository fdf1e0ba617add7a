"""The settings of infer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """window : side of the windows, px, None for one chosen for speed and memory; precision : fp32, bf16, or auto (see
    ``stages.network.precision``); any_gsd : whether the grid may differ from that of training; geotiff : whether the
    map is also written as a GeoTIFF.
    """

    window: int | None = None
    device: str = "auto"
    precision: str = "auto"
    any_gsd: bool = False
    shard: tuple[int, int] = (0, 1)
    geotiff: bool = True
