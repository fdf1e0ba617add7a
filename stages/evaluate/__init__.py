"""`lunargr evaluate`: measured against rendered crops of one split, for the learned model and its baselines."""

from __future__ import annotations

from stages.evaluate.run import Config, run

__all__ = ["Config", "run"]
