"""Runs a stage: refuses what cannot be done before anything is made, locks the output, cuts the work into parts, joins them.

A stage is a function from files to files that :func:`stage` decorates. The function does the work; what it reads and writes,
and whether it works in parts, is declared beside it:

    stage       the decorator
    job         the parts of one output: their folder, what of them is finished
    engines     who works on parts: this process, or the workers of a Dask cluster
"""

from __future__ import annotations

from stages.common.runner.stage import Call, as_geotiff, prepared, stage, the_map

__all__ = ["Call", "as_geotiff", "prepared", "stage", "the_map"]
