"""Angles that another program worked out for the pixels of an image, such as the backplanes of ISIS phocube."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.errors import InputError
from stages.common.arrays import Floats32
from stages.physics.images.displacement import Field
from stages.physics.images.source_images import Source, open_source
from stages.physics.images.table import Frame
from stages.physics.maps.grid import Grid
from stages.physics.maps.rasters import open_raster
from stages.physics.maps.window import Box

PLANES = ("incidence_deg", "emission_deg", "phase_deg")


@dataclass(frozen=True)
class GivenAngles:
    """sources : the open bands, by plane"""

    sources: dict[str, Source]

    def read(self, box: Box, field: Field | None) -> dict[str, Floats32]:
        """(h, w) degrees on a window of the scene's grid, by plane, NaN where the file has none. field : see ``Source.read``"""
        found = {}
        for plane, source in self.sources.items():
            pixels = source.read(*box, field)
            found[plane] = np.where(pixels.valid, pixels.values, np.nan).astype(np.float32)
        return found


def angle_bands(path: Path) -> dict[str, int]:
    """The bands, counted from 1, that hold incidence, emission and phase, by the names in the file's label.

    A band of local angles is taken before one on the ellipsoid. Raises InputError where one is missing.
    """
    with open_raster(path, "a file of angles") as dataset:
        names = [(text or "").lower().replace("_", " ") for text in dataset.descriptions]
    found = {}
    for plane in PLANES:
        word = plane.removesuffix("_deg")
        local = [k for k, name in enumerate(names, start=1) if "local" in name and word in name]
        bands = local or [k for k, name in enumerate(names, start=1) if word in name]
        if not bands:
            listed = ", ".join(name or "no name" for name in names)
            raise InputError(
                f"{path}: expected bands named incidence, emission and phase (as from phocube), found {listed}; name the bands."
            )
        found[plane] = bands[0]
    return found


@contextlib.contextmanager
def open_angles(frame: Frame, grid: Grid, elevation: Any, heights: tuple[float, float]) -> Iterator[GivenAngles | None]:
    """The angles that the table of images names for a frame, None where it names none. Raises LunargrError."""
    if frame.angles is None:
        yield None
        return
    with contextlib.ExitStack() as stack:
        sources = {}
        for plane, band in angle_bands(frame.angles).items():
            one = replace(frame, path=frame.angles, band=band)
            sources[plane] = stack.enter_context(open_source(one, grid, elevation, heights))
        yield GivenAngles(sources)
