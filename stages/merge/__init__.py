"""merge: one artefact from its parts. stage: from files to files; parts: checks of the parts; joining: of variables."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.merge.config import Config

if TYPE_CHECKING:
    from stages.merge.stage import run

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "run"]
