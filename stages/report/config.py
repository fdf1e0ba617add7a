"""What report is asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """The page's title."""

    title: str = "Lunar reflectance learned from terrain"
