"""sample: crops and a geographic split. stage: from files to files; places: crop centres; audit: of the split."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.sample.config import Config

if TYPE_CHECKING:
    from stages.sample.audit import audit, read_audit
    from stages.sample.stage import run

__getattr__ = imported_later(__name__, "stage", "audit")
__all__ = ["Config", "audit", "read_audit", "run"]
