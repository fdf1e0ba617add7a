"""view: one self-contained page that relights a learned map in a browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.view.config import Config

if TYPE_CHECKING:
    from stages.view.stage import Summary, run

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "Summary", "run"]
