"""The summary of pairs, for the line at the end."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from schemas import PAIRS, atomic_path, open_artefact
from schemas.packing import read
from schemas.reading import read_strings
from stages.physics.images.displacement import Field
from stages.physics.images.registration import Shift

# frame variables of pairs.h5, in the order of Resemblance's fields
RESEMBLANCE = ("rendering_correlation", "rendering_chance", "rendering_contrast", "image_mean")
FEW_NEGATIVE = 0.001  # of an image's pixels: noise in shadows


@dataclass(frozen=True)
class Registered:
    """The registration of one image: the displacement that was taken off, and the shift of each block."""

    image_id: str
    field: Field
    blocks: tuple[tuple[float, float, Shift], ...]  # row and column of the middle, and the shift there
    seconds: float


@dataclass(frozen=True)
class Resemblance:
    """Of one image and its renderings, over some blocks; NaN where nothing is known.

    correlation : of small structure, mean over the blocks; chance : the largest with renderings turned, mirrored or
    exchanged; contrast : structure of the image over that of the rendering, both relative to their means
    mean : of the image, in its own units
    """

    image_id: str
    correlation: float
    chance: float
    contrast: float
    mean: float

    @property
    def is_chance(self) -> bool:
        """Whether the image resembles its ground no more than other ground. Not where nothing was compared."""
        return not math.isnan(self.mean) and not self.correlation > self.chance


@dataclass(frozen=True)
class Summary:
    """What project wrote, for the line at the end.

    negative : image_id -> share of its valid pixels whose I/F is below 0, of images with more than FEW_NEGATIVE of them
    """

    pairs: int
    valid_share: float
    incidence_deg: tuple[float, float]
    emission_deg: tuple[float, float]
    shadowed_share: float
    units: str
    registered: tuple[Registered, ...] = ()
    resemblances: tuple[Resemblance, ...] = ()
    negative: Mapping[str, float] = field(default_factory=dict)


def write_shifts(path: Path, registered: Sequence[Registered]) -> None:
    """A table of the blocks of registered images: where each is on the scene's grid, and the shift there."""
    with atomic_path(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["image_id", "row", "col", "dx_px", "dy_px", "sigma_px", "correlation", "lead", "refused"])
        for image in registered:
            for row, col, s in image.blocks:
                numbers = (f"{v:.4f}" for v in (s.dx, s.dy, s.sigma, s.correlation, s.lead))
                out.writerow([image.image_id, row, col, *numbers, s.refused])


def summarise(pairs: Path) -> Summary:
    """The summary of a file that was merged from parts."""
    with open_artefact(pairs, PAIRS) as file:
        sun, camera = file["sun_direction_enu"][...], file["camera_position_enu"][...]
        names, index = read_strings(file, "image_id"), file["image_index"][...]
        units = "dn" if str(file["image"].attrs["units"]) == "dn" else "iof"
        seen = shadowed = total = 0
        below, valid_px = np.zeros(len(names), np.int64), np.zeros(len(names), np.int64)
        for k in range(file["valid"].shape[0]):
            valid = file["valid"][k].astype(bool)
            angle = read(file["sun_horizon_deg"], k).astype(np.float64)
            above = np.radians(angle) > math.asin(sun[k, 2])
            seen, shadowed, total = seen + int(valid.sum()), shadowed + int((valid & above).sum()), total + valid.size
            valid_px[index[k]] += valid.sum()
            if units == "iof":
                below[index[k]] += (read(file["image"], k)[valid] < 0).sum()
        compared = read_resemblances(file)
    incidence = np.degrees(np.arccos(sun[:, 2])).tolist()
    emission = np.degrees(np.arccos(camera[:, 2] / np.linalg.norm(camera, axis=1))).tolist()
    shares = seen / max(1, total), shadowed / max(1, seen)
    negative = often_negative(dict(zip(names, zip(below.tolist(), valid_px.tolist(), strict=True), strict=True)))
    return Summary(
        len(sun), shares[0], extremes(incidence), extremes(emission), shares[1], units, (), compared, negative
    )


def read_resemblances(file: h5py.File) -> tuple[Resemblance, ...]:
    """What an open pairs.h5 says of its images and their renderings; nothing where it does not."""
    if any(name not in file for name in RESEMBLANCE):
        return ()
    columns = [file[name][...].tolist() for name in RESEMBLANCE]
    return tuple(map(Resemblance, read_strings(file, "image_id"), *columns))


def often_negative(counts: Mapping[str, tuple[int, int]]) -> dict[str, float]:
    """Shares of negative pixels that are more than FEW_NEGATIVE. counts : image_id -> negative and valid pixels"""
    return {name: below / valid for name, (below, valid) in counts.items() if below > FEW_NEGATIVE * valid}


def extremes(angles: Sequence[float]) -> tuple[float, float]:
    """The least and the largest, NaN where there are none."""
    return min(angles, default=math.nan), max(angles, default=math.nan)
