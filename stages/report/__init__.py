"""`lunargr report`: everything a run has produced, on one page."""

from __future__ import annotations

from stages.report.run import Config, run

__all__ = ["Config", "run"]
