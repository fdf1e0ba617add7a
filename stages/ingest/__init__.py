"""Stage ingest. stage: from files to files; plan: the grid; elevation: the DEM on it; validity: what the images see; config: the options."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.ingest.config import Config

if TYPE_CHECKING:
    from stages.ingest.stage import (
        Summary,
        check_positions,
        count_bands,
        image_names,
        run,
        source_files,
        summarise,
    )

__getattr__ = imported_later(__name__, "stage")
__all__ = [
    "Config",
    "Summary",
    "check_positions",
    "count_bands",
    "image_names",
    "run",
    "source_files",
    "summarise",
]
