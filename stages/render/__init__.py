"""render: images of a terrain with its reflectance, for any Sun and camera, with backplanes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.render.config import Config, StereoConfig, Summary

if TYPE_CHECKING:
    from stages.render.stage import run
    from stages.render.stereo import run_stereo
    from stages.render.views import run_trajectory

__getattr__ = imported_later(__name__, "stage", "stereo", "views")
__all__ = ["Config", "StereoConfig", "Summary", "run", "run_stereo", "run_trajectory"]
