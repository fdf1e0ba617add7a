"""Writing pairs one by one, with the decimals that matter, and counting them for the line at the end."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas import ArtefactWriter, InputError
from stages.physics.images.orthorectify import Ortho
from stages.physics.images.table import Frame
from stages.physics.maps import rasters
from stages.project.summary import Summary, extremes, often_negative

# Digits after the point that pairs.h5 keeps; docs/resources.md lists them.
IOF_DECIMALS, COUNT_DECIMALS, HORIZON_DECIMALS = 5, 1, 1
RAY_DECIMALS = {"detector_line": 2, "detector_sample": 2, "emission_deg": 2, "phase_deg": 3}
ALWAYS = ("valid", "sun_direction_enu", "camera_position_enu", "convergence_deg")
DISPLACEMENT = ("displacement_col_px", "displacement_row_px")


@dataclass(frozen=True)
class Pair:
    """One crop of one image. image, elevation, valid, horizon (rad) : (h, w); sun, camera : (3,);
    displacement : (dx, dy) px at its middle, taken off; ortho : the camera's side, None for map-projected images
    """

    image: NDArray[np.float32]
    elevation: NDArray[np.float32]
    valid: NDArray[np.bool_]
    horizon: NDArray
    sun: NDArray[np.float64]
    camera: NDArray[np.float64]
    convergence_deg: float
    displacement: tuple[float, float]
    ortho: Ortho | None


class PairDatasets:
    """The datasets of pairs.h5 that are filled pair by pair."""

    def __init__(
        self, writer: ArtefactWriter, unit: str, decimals: Mapping[str, int | None], rays: bool, displaced: bool
    ) -> None:
        names = {"elevation": None, "sun_horizon_deg": None, "image": unit}
        self.sets = {name: writer.dataset(name, unit=u, decimals=decimals.get(name)) for name, u in names.items()}
        self.sets |= {name: writer.dataset(name) for name in (*ALWAYS, *(DISPLACEMENT if displaced else ()))}
        self.rays = [writer.dataset(name, decimals=decimals.get(name)) for name in RAY_DECIMALS] if rays else []

    def put(self, k: int, pair: Pair) -> None:
        """Write one pair."""
        values = {
            "image": np.where(pair.valid, pair.image, np.nan),
            "valid": pair.valid,
            "elevation": pair.elevation,
            "sun_horizon_deg": np.degrees(pair.horizon),
            "sun_direction_enu": pair.sun,
            "camera_position_enu": pair.camera,
            "convergence_deg": pair.convergence_deg,
            **dict(zip(DISPLACEMENT, pair.displacement, strict=True)),
        }
        for name, dataset in self.sets.items():
            _put_known(dataset, k, np.asarray(values[name]))
        if pair.ortho is not None:
            ray = pair.ortho
            angles = (ray.detector_line, ray.detector_sample, np.degrees(ray.emission), np.degrees(ray.phase))
            for dataset, value in zip(self.rays, angles, strict=True):
                _put_known(dataset, k, value)


def _put_known(target: h5py.Dataset, k: int, values: NDArray) -> None:
    """Write one pair's values, unknown ones as the fill value: a NaN among packed values would spoil its chunk."""
    known = np.isfinite(values)
    target[k] = values if known.all() else np.where(known, values, target.fillvalue)


@dataclass
class Tally:
    """Counts of what has been written so far."""

    pairs: int = 0
    valid: int = 0
    shadowed: int = 0
    incidence: list[float] = field(default_factory=list)
    emission: list[float] = field(default_factory=list)
    negative: dict[str, tuple[int, int]] = field(default_factory=dict)

    def add(self, pair: Pair, frame: Frame) -> None:
        """Count one pair of an image."""
        below, valid = self.negative.get(frame.image_id, (0, 0))
        if frame.units == "iof":
            below += int((pair.image[pair.valid] < 0).sum())
        self.negative[frame.image_id] = below, valid + int(pair.valid.sum())
        up = pair.sun[2]
        self.pairs += 1
        self.valid += int(pair.valid.sum())
        self.shadowed += int((pair.valid & (pair.horizon > math.asin(up))).sum())
        self.incidence.append(math.degrees(math.acos(up)))
        self.emission.append(math.degrees(math.acos(pair.camera[2] / np.linalg.norm(pair.camera))))

    def summary(self, size: int, units: str) -> Summary:
        """Of all that was counted. size : px, of a crop's side; units : of the images, 'iof' or 'dn'"""
        return Summary(
            self.pairs,
            self.valid / max(1, self.pairs * size * size),
            extremes(self.incidence),
            extremes(self.emission),
            self.shadowed / max(1, self.valid),
            units,
            negative=often_negative(self.negative),
        )


def kept_decimals(frames: list[Frame], units: str, gsd: float) -> dict[str, int | None]:
    """Digits after the point: elevations in steps of at most gsd / 400, images of 1e-5 of I/F or a tenth of a count.

    Counts that are not whole numbers in the images keep all their digits, since their scale is not known.
    """
    image: int | None = IOF_DECIMALS if units == "iof" else COUNT_DECIMALS
    if units == "dn":
        for frame in frames:
            with contextlib.suppress(InputError), rasters.open_raster(frame.path) as source:
                if np.dtype(source.dtypes[0]).kind == "f" or source.scales[0] < 1:
                    image = None
    elevation = max(0, math.ceil(math.log10(400 / gsd)))
    return {"image": image, "elevation": elevation, "sun_horizon_deg": HORIZON_DECIMALS, **RAY_DECIMALS}
