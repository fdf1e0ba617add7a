"""`lunargr report`: everything a run has produced, on one page."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.report.config import Config

if TYPE_CHECKING:
    from stages.report.stage import run

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "run"]
