"""infer: coefficient maps for a DEM.

stage: from files to files; windows: where the map is cut; terrain: the DEM in rows; parallel: threads; writing: the map
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.infer.config import Config

if TYPE_CHECKING:
    from stages.infer.stage import check_body, count_bands, run, summarise

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "check_body", "count_bands", "run", "summarise"]
