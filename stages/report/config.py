"""The settings of report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """note : a remark above the results"""

    title: str = "Lunar reflectance learned from terrain"
    note: str = ""
