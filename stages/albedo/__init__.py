"""Stage albedo. run: the stage; references: photographs against the map; calibrate: gains and errors; pyramid: scales;
posterior: the estimate; prior: what the network says of its own errors; intervals: how far unseen images lie; writing: the new map."""

from __future__ import annotations

from stages.albedo.calibrate import Calibration
from stages.albedo.config import Config, Summary
from stages.albedo.run import calibrate_to, check_files, count_bands, run, run_part, source_files, summarise

__all__ = [
    "Calibration",
    "Config",
    "Summary",
    "calibrate_to",
    "check_files",
    "count_bands",
    "run",
    "run_part",
    "source_files",
    "summarise",
]
