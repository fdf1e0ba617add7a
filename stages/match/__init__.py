"""`lunargr match`: do features of rendered images lie where those of the measured image lie?"""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.match.config import Config

if TYPE_CHECKING:
    from stages.match.stage import run

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "run"]
