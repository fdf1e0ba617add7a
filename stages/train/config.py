"""The settings of train."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from schemas.files.outputs import Output


@dataclass(frozen=True)
class Config:
    """Defaults are what does best on validation ground; the paper's are named in the command's help.

    maps : coefficients predicted place by place, the others are fitted globally; empty: the model's own choice
    positive : keep coefficients nearly positive, as Lunar-G2R does; models linear in their coefficients only
    brightness : weight of each crop's overall brightness in the loss, 0..1; 1: plain squared errors. Whole crops are
        bright or dark for reasons that terrain does not show: counted in full, the network learns ground by heart
    schedule : 'constant' or 'cosine'
    """

    model: str = "hapke"
    maps: tuple[str, ...] = ()
    positive: bool = False
    epochs: int = 20
    batch: int = 32
    lr: float = 3e-3
    schedule: str = "cosine"
    widths: tuple[int, ...] = (8, 16, 32)
    dropout: tuple[float, ...] = (0.0,)
    brightness: float = 0.1
    augment: bool = True
    seed: int = 0
    device: str = "auto"
    precision: str = "auto"
    extend: str | None = None


def state_path(output: Output) -> Path:
    """Where the state of an unfinished run is, beside its checkpoint."""
    return output.file.with_name(f"{output.file.stem}.resume.h5")
