"""`lunargr evaluate`: measured against rendered crops of one split, for the learned model and its baselines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.evaluate.config import Config

if TYPE_CHECKING:
    from stages.evaluate.stage import run, run_in_parts

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "run", "run_in_parts"]
