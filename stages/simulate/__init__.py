"""`lunargr simulate`: a lunar-looking scene with known truth, written as if it were real data.

recipe.py       every number of a scene                     noise.py     fractal noise as a function of place
craters.py      population, profiles, decay                 terrain.py   the ground, block by block
reflectance.py  the truth's albedo and other parameters     orbits.py    times, Sun, spacecraft, strips
radiance.py     light from each DEM pixel, optics           sensor.py    resampling, response, noise, footprints
hidden.py       effects that only the truth records         write.py     DEM, images, table, truth
stage.py        the stage: all of it in order
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output, Target
from stages.common import runner
from stages.common.progress import Progress, show_nothing
from stages.simulate.recipe import Config, make_config, read_recipe, recipe_json

if TYPE_CHECKING:
    from stages.simulate.stage import Summary

__all__ = ["Config", "make_config", "read_recipe", "recipe_json", "run"]


def _targets(call: runner.Call) -> Iterator[Target]:
    from stages.simulate.stage import scene_files

    yield from (Target(call.output.file / name) for name in scene_files(call.config))


@runner.stage(writes=_targets, content=lambda summary: summary.table())
def run(output: Output | Path, config: Config, progress: Progress = show_nothing) -> Summary:
    """Simulate a scene into a folder: dem.tif, images/*.tif, images.csv, truth.h5, truth.tif, record.json.

    Raises ConfigError where files exist that may not be replaced.
    """
    from stages.simulate.stage import work

    return work(Output.at(output).file, config, progress)
