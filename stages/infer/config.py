"""The settings of infer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """window, stride : px; windows overlap by their difference and are blended; None: chosen for speed and memory;
    offset : px, shifts their lattice; precision : fp32, bf16, or auto (see ``stages.network.precision``); any_gsd :
    whether the grid may differ from that of training; geotiff : whether the map is written as a GeoTIFF as well.
    """

    window: int | None = None
    stride: int | None = None
    offset: int = 0
    device: str = "auto"
    precision: str = "auto"
    any_gsd: bool = False
    shard: tuple[int, int] = (0, 1)
    geotiff: bool = True
