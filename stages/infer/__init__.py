"""Stage infer. run: the stage; windows: where the map is cut; terrain: the DEM in rows; working: threads; writing: the map."""

from __future__ import annotations

from stages.infer.config import Config, Summary
from stages.infer.run import check_body, check_files, count_bands, open_terrain, run, summarise
from stages.infer.windows import axis_windows, blend_weights

__all__ = [
    "Config",
    "Summary",
    "axis_windows",
    "blend_weights",
    "check_body",
    "check_files",
    "count_bands",
    "open_terrain",
    "run",
    "summarise",
]
