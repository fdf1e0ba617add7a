"""ingest: a DEM on a metric grid, and the ground that images show of it.

stage: from files to files; plan: the choice of the grid; elevation: the DEM on it; validity: masks of the images
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.ingest.config import Config

if TYPE_CHECKING:
    from stages.ingest.stage import check_positions, count_bands, image_names, run, source_files, summarise

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "check_positions", "count_bands", "image_names", "run", "source_files", "summarise"]
