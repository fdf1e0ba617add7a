"""The settings of infer, and its summary of a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stages.physics.maps.grid import Grid


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


@dataclass(frozen=True)
class Summary:
    """Ranges of the coefficients, for the table at the end: name -> (mean, std, 1 %, 99 %)."""

    grid: Grid
    model: str
    valid_share: float
    windows: int
    coefficients: dict[str, tuple[float, float, float, float]]
