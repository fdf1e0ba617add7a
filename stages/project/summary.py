"""What pairs hold, in one line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas import PAIRS, open_artefact
from schemas.reading import unpack
from stages.project.config import Summary


def summarise(pairs: Path) -> Summary:
    """What pairs hold, for the line at the end: of a file that was put together from parts."""
    with open_artefact(pairs, PAIRS) as file:
        sun, camera = file["sun_direction_enu"][...], file["camera_position_enu"][...]
        seen = shadowed = total = 0
        for k in range(file["valid"].shape[0]):
            valid = file["valid"][k].astype(bool)
            angle = unpack(file["sun_horizon_deg"], file["sun_horizon_deg"][k]).astype(np.float64)
            above = np.radians(angle) > math.asin(sun[k, 2])
            seen, shadowed, total = seen + int(valid.sum()), shadowed + int((valid & above).sum()), total + valid.size
    incidence = np.degrees(np.arccos(sun[:, 2]))
    emission = np.degrees(np.arccos(camera[:, 2] / np.linalg.norm(camera, axis=1)))

    def extremes(angles: NDArray[np.float64]) -> tuple[float, float]:
        return (float(angles.min()), float(angles.max())) if len(angles) else (math.nan, math.nan)

    return Summary(len(sun), seen / max(1, total), extremes(incidence), extremes(emission), shadowed / max(1, seen))
