"""`lunargr simulate`: a lunar-looking scene with known truth, written as if it were real data.

recipe.py       every number of a scene                     noise.py     fractal noise as a function of place
craters.py      population, profiles, decay                 terrain.py   the ground, block by block
reflectance.py  the truth's albedo and other parameters     orbits.py    times, Sun, spacecraft, strips
radiance.py     light from each DEM pixel, optics           sensor.py    resampling, response, noise, footprints
hidden.py       effects that only the truth records         write.py     DEM, images, table, truth
stage.py        the stage: all of it in order
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.simulate.recipe import Config, make_config, read_recipe, recipe_json

if TYPE_CHECKING:
    from stages.simulate.stage import run

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "make_config", "read_recipe", "recipe_json", "run"]
