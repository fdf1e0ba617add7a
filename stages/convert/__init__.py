"""`lunargr convert`: coefficient maps in a GeoTIFF, from one program's convention to another's.

Bands are known by their descriptions, never by their position: programs order the same coefficients differently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, show_nothing

if TYPE_CHECKING:
    from stages.convert.stage import Report

__all__ = ["Config", "run"]


@dataclass
class Config:
    """source, target : conventions, SYSTEM:MODEL
    bands : where the file's descriptions do not name its quantities: names of all its bands in their order, or
        'NAME=INDEX' (from 1) for those that are wanted, as in a file with several wavelengths
    approximate : convert although the target cannot hold everything
    """

    source: str
    target: str
    bands: Sequence[str] | None = None
    approximate: bool = False


@runner.stage()
def run(source: Path, output: Output | Path, config: Config, progress: Progress = show_nothing) -> Report:
    """Convert the coefficient maps of ``source`` into ``output``, a float32 GeoTIFF on the same grid, NaN as nodata.

    Raises InputError for a file without the needed bands, ConfigError for conventions that have no conversion or would
    lose something, RegistryError for an unknown convention.
    """
    from stages.convert.stage import work

    return work(source, Output.at(output).file, config, progress)
