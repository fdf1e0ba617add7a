"""`lunargr evaluate`: measured against rendered crops of one split, for the learned model and its baselines."""

from __future__ import annotations

from stages.evaluate.config import Config
from stages.evaluate.run import run, run_in_parts

__all__ = ["Config", "run", "run_in_parts"]
