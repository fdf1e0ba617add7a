"""project: orthorectify the images onto the crops and add Sun, camera and horizon: `pairs.h5`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.project.config import Config

if TYPE_CHECKING:
    from stages.project.inputs import count_pairs, scene_of, source_files
    from stages.project.stage import run
    from stages.project.summary import Registered, Resemblance, summarise

__getattr__ = imported_later(__name__, "stage", "inputs", "summary")
__all__ = ["Config", "Registered", "Resemblance", "count_pairs", "run", "scene_of", "source_files", "summarise"]
