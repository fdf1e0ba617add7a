"""Stage ingest. run: the stage; plan: the grid; elevation: the DEM on it; validity: what the images see; config: the options."""

from __future__ import annotations

from stages.ingest.config import Config
from stages.ingest.run import (
    Summary,
    check_positions,
    count_bands,
    image_names,
    is_artefact,
    run,
    source_files,
    summarise,
)

__all__ = [
    "Config",
    "Summary",
    "check_positions",
    "count_bands",
    "image_names",
    "is_artefact",
    "run",
    "source_files",
    "summarise",
]
