"""train: a U-Net that predicts reflectance from terrain. stage: all of it; training: what is learned; epoch: one pass over the pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.train.config import Config

if TYPE_CHECKING:
    from stages.train.checks import check
    from stages.train.stage import Summary, run

__getattr__ = imported_later(__name__, "stage", "checks")
__all__ = ["Config", "Summary", "check", "run"]
