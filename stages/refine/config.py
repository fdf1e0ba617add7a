"""What refine is told, and what it says of the map."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """draws : of the posterior, for standard deviations; geotiff : whether the map is written as a GeoTIFF as well"""

    draws: int = 8
    shard: tuple[int, int] = (0, 1)
    geotiff: bool = True


@dataclass(frozen=True)
class Summary:
    """For the lines at the end. reason : why the DEM came back as it was, empty where it was corrected

    gain : percent by which the squared error of images left out, each at its best gain, falls, and its 95 % interval
    correction, correction_std : m, rms and median; waves : px, std of a wave's height in m, of log albedo, share of the
    images' weight that is left
    """

    images: tuple[str, ...]
    reason: str
    gain: tuple[float, float, float]
    correction: float
    correction_std: float
    waves: tuple[tuple[float, float, float, float], ...]
