"""What match is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Config:
    """Options of match; ``count`` crops of ``split`` are drawn with ``seed``."""

    matchers: tuple[str, ...] = ("daisy", "sift")
    split: str = "test"
    count: int = 24
    features_model: Path | None = None
    lightglue_model: Path | None = None
    seed: int = 0
    device: str = "auto"
