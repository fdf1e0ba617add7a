"""The summary of pairs, for the line at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas import PAIRS, open_artefact
from schemas.reading import unpack
from stages.physics.images.displacement import Field
from stages.physics.images.registration import Shift


@dataclass(frozen=True)
class Registered:
    """The registration of one image: the displacement that was taken off, and the shift of each block."""

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
    """The summary of a file that was merged from parts."""
    with open_artefact(pairs, PAIRS) as file:
        sun, camera = file["sun_direction_enu"][...], file["camera_position_enu"][...]
        seen = shadowed = total = 0
        for k in range(file["valid"].shape[0]):
            valid = file["valid"][k].astype(bool)
            angle = unpack(file["sun_horizon_deg"], file["sun_horizon_deg"][k]).astype(np.float64)
            above = np.radians(angle) > math.asin(sun[k, 2])
            seen, shadowed, total = seen + int(valid.sum()), shadowed + int((valid & above).sum()), total + valid.size
    incidence = np.degrees(np.arccos(sun[:, 2])).tolist()
    emission = np.degrees(np.arccos(camera[:, 2] / np.linalg.norm(camera, axis=1))).tolist()
    return Summary(len(sun), seen / max(1, total), extremes(incidence), extremes(emission), shadowed / max(1, seen))


def extremes(angles: Sequence[float]) -> tuple[float, float]:
    """The least and the largest, NaN where there are none."""
    return min(angles, default=math.nan), max(angles, default=math.nan)
