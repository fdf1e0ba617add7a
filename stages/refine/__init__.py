"""refine: heights and albedo together, from all photographs of a place. stage: from files to files; learn: spectra and noise;
judge: whether images left out gain; patch: photographs beside the map; solve: the posterior.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.errors import ConfigError
from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.refine.config import Config, Summary

if TYPE_CHECKING:
    from stages.refine.judge import Learned

__all__ = ["Config", "Summary", "calibrate_to", "run"]


def _check(call: runner.Call) -> None:
    if call.output.in_parts and call.arguments.get("calibration") is not None:
        raise ConfigError("`calibration`: `scheduler` and `resume` make their own; give it to `shard` alone.")
    if call.config.draws < 2:
        raise ConfigError(f"`draws`: expected at least 2, found {call.config.draws}.")


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
    """Write the map with refined heights and albedo. svbrdf : from `lunargr albedo`, whose images are used

    calibration : from :func:`calibrate_to`, which all shards share. Raises LunargrError.
    """
    from stages.refine.stage import work

    return work(svbrdf, scene, calibration, Output.at(output), config, progress)


@runner.stage(check=_check)
def calibrate_to(
    svbrdf: Path, scene: Path, output: Output | Path, config: Config, progress: Progress = show_nothing
) -> Learned:
    """Write spectra, noise and the gain on images left out, which all parts of one map share, as JSON. Raises LunargrError."""
    from stages.refine.stage import calibrate_images

    return calibrate_images(svbrdf, scene, Output.at(output), config, progress)
