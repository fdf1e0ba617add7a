"""train: a U-Net that predicts reflectance from terrain.

stage: from files to files; start: the uniform surface that it begins at; training: what every step works with;
epoch, steps: one pass over the pairs; processes: several of them; resume: an unfinished run; deviations: of the maps
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.train.config import Config

if TYPE_CHECKING:
    from stages.train.checks import check
    from stages.train.stage import run

__getattr__ = imported_later(__name__, "stage", "checks")
__all__ = ["Config", "check", "run"]
