"""Stage albedo. stage: from files to files; references: photographs against the map; calibrate: gains and errors; pyramid: scales;
posterior: the estimate; prior: what the network says of its own errors; intervals: how far unseen images lie; writing: the new map.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output, map_targets
from stages.albedo.config import Config, Summary
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing

if TYPE_CHECKING:
    from stages.albedo.calibrate import Calibration

__all__ = ["Config", "Summary", "calibrate_to", "run", "run_calibrated"]


@runner.stage(writes=lambda call: map_targets(call.output, call.config.as_geotiff), in_parts=True)
def run(
    svbrdf: Path,
    scene: Path,
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> Summary:
    """Write the map with albedo. Raises LunargrError."""
    from stages.albedo.stage import work

    return work(svbrdf, scene, None, Output.at(output), config, progress)


@runner.stage(writes=lambda call: map_targets(call.output, call.config.as_geotiff))
def run_calibrated(
    svbrdf: Path,
    scene: Path,
    calibration: Path,
    output: Output | Path,
    config: Config,
    progress: Progress = show_nothing,
) -> Summary:
    """:func:`run` with the calibration of :func:`calibrate_to`, which all shards share. Raises LunargrError."""
    from stages.albedo.stage import work

    return work(svbrdf, scene, calibration, Output.at(output), config, progress)


@runner.stage()
def calibrate_to(
    svbrdf: Path, scene: Path, output: Output | Path, config: Config, progress: Progress = show_nothing
) -> Calibration:
    """Write the calibration of the images, which all parts of one map share, as JSON. Raises LunargrError."""
    from stages.albedo.stage import calibrate_images

    return calibrate_images(svbrdf, scene, Output.at(output), config, progress)
