"""project: orthorectify the images onto the crops and add Sun, camera and horizon: `pairs.h5`."""

from stages.project.config import Config, Registered, Summary
from stages.project.geometry import Geometry, crop_geometry
from stages.project.inputs import count_pairs, scene_of, source_files
from stages.project.run import run
from stages.project.summary import summarise

__all__ = [
    "Config",
    "Geometry",
    "Registered",
    "Summary",
    "count_pairs",
    "crop_geometry",
    "run",
    "scene_of",
    "source_files",
    "summarise",
]
