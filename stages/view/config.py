"""What view is asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """What the page holds and shows first; angles in degrees over the map's middle, azimuth from true north."""

    max_px: int = 2048
    photographs: int = 12
    sun_azimuth_deg: float = 270.0
    sun_elevation_deg: float = 25.0
    title: str | None = None
