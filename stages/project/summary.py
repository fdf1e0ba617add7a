"""What pairs hold, in one line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas import PAIRS, open_artefact
from schemas.reading import unpack
from stages.physics.images.displacement import Field
from stages.physics.images.registration import Shift


@dataclass(frozen=True)
class Registered:
    """How one image lay against its rendering: the displacement that was taken off, and each block's own answer."""

    image_id: str
    field: Field
    blocks: tuple[tuple[float, float, Shift], ...]  # row and column of the middle, and the shift there
    seconds: float


@dataclass(frozen=True)
class Summary:
    """What project wrote, for the line at the end."""

    pairs: int
    valid_share: float
    incidence_deg: tuple[float, float]
    emission_deg: tuple[float, float]
    shadowed_share: float
    registered: tuple[Registered, ...] = ()


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
