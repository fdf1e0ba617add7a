"""Stage albedo. stage: from files to files; references: photographs against the map; calibrate: gains and errors; pyramid: scales;
posterior: the estimate; prior: what the network says of its own errors; intervals: how far unseen images lie; writing: the new map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.albedo.config import Config, Summary

if TYPE_CHECKING:
    from stages.albedo.calibrate import Calibration
    from stages.albedo.stage import calibrate_to, count_bands, run, run_calibrated, source_files, summarise

__getattr__ = imported_later(__name__, "stage", "calibrate")
__all__ = [
    "Calibration",
    "Config",
    "Summary",
    "calibrate_to",
    "count_bands",
    "run",
    "run_calibrated",
    "source_files",
    "summarise",
]
