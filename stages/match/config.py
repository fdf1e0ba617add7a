"""What match is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

FIGURES = 4  # comparisons that are drawn


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


def figure_name(matcher: str, number: int) -> str:
    """Of a picture of matches; number : of the comparison, from 0"""
    return f"match_{matcher}_{number + 1}.png"


def figure_files(folder: Path, config: Config) -> list[Path]:
    """All pictures that may be written."""
    return [folder / figure_name(m, k) for m in dict.fromkeys(config.matchers) for k in range(FIGURES)]
