"""Stage albedo. stage: from files to files; references: photographs against the map; calibrate: gains and errors; pyramid: scales;
posterior: the estimate; prior: what the network says of its own errors; intervals: how far unseen images lie; writing: the new map.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.errors import ConfigError
from schemas.files.outputs import Output
from stages.albedo.config import Config, Summary
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing

if TYPE_CHECKING:
    from stages.photographs.calibrate import Calibration

__all__ = ["Config", "Summary", "calibrate_to", "run"]


def _check(call: runner.Call) -> None:
    if call.output.in_parts and call.arguments["calibration"] is not None:
        raise ConfigError("`calibration`: `scheduler` and `resume` make their own; give it to `shard` alone.")


@runner.stage(writes=runner.the_map, check=_check, in_parts=True)
def run(
    svbrdf: Path,
    scene: Path,
    calibration: Path | None,
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> Summary:
    """Write the map with albedo. calibration : from :func:`calibrate_to`, which all shards share. Raises LunargrError."""
    from stages.albedo.stage import work

    return work(svbrdf, scene, calibration, Output.at(output), config, progress)


@runner.stage()
def calibrate_to(
    svbrdf: Path, scene: Path, output: Output | Path, config: Config, progress: Progress = show_nothing
) -> Calibration:
    """Write the calibration of the images, which all parts of one map share, as JSON. Raises LunargrError."""
    from stages.albedo.stage import calibrate_images

    return calibrate_images(svbrdf, scene, Output.at(output), config, progress)
