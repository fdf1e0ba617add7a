"""The settings of train."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from schemas.errors import ConfigError
from schemas.files.outputs import Output
from schemas.later import without

SCHEDULES = ("constant", "cosine")


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

    def check(self) -> None:
        """Refuse numbers and names that cannot be, without PyTorch. Raises ConfigError, RegistryError."""
        if self.epochs < 1 or self.batch < 1:
            raise ConfigError(f"`epochs` and `batch`: expected at least 1, found {self.epochs} and {self.batch}.")
        if not (math.isfinite(self.lr) and 0 < self.lr < 1):
            raise ConfigError(f"`lr`: expected a number between 0 and 1, found {self.lr}.")
        if self.schedule not in SCHEDULES:
            raise ConfigError(f"`schedule`: expected one of {', '.join(SCHEDULES)}; found '{self.schedule}'.")
        if not 0 <= self.brightness <= 1:
            raise ConfigError(f"`brightness`: expected a number from 0 to 1, found {self.brightness}.")
        with without("torch"):
            from stages.physics.photometry import get_model

            model = get_model(self.model)
        model.choose_maps(self.maps)
        if self.positive and not model.linear:
            raise ConfigError(f"`positive`: expected a model that is linear in its coefficients, found '{model.name}'.")


def state_path(output: Output) -> Path:
    """Where the state of an unfinished run is, beside its checkpoint."""
    return output.file.with_name(f"{output.file.stem}.resume.h5")
