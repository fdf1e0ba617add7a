"""Writing pairs one by one, packed into 16 bits, and counting them for the line at the end."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas import ArtefactWriter, InputError
from schemas.packing import Packing, pack
from stages.physics.images.orthorectify import Ortho
from stages.physics.images.table import Frame
from stages.physics.maps import rasters
from stages.project.summary import Summary, extremes, often_negative

IMAGE = Packing(33 * 2.0**-20)  # I/F of -1.03 to 1.03 in steps of 3.1e-5, as fine as the calibrated images of LROC
COUNTS = Packing(2.0**-7)  # of images of 8 bits
DEGREES = Packing(2.0**-8)
RAYS = ("detector_line", "detector_sample", "emission_deg", "phase_deg")
ALWAYS = ("valid", "reference_elevation", "sun_direction_enu", "camera_position_enu", "convergence_deg")
DISPLACEMENT = ("displacement_col_px", "displacement_row_px")


@dataclass(frozen=True)
class Layout:
    """How the values of pairs are packed; docs/resources.md lists the steps.

    packings : of the variables that are; relative : whether heights count from a reference of each pair
    """

    packings: Mapping[str, Packing] = field(default_factory=dict)
    relative: bool = False

    @classmethod
    def of(cls, frames: Sequence[Frame], units: str, heights: tuple[float, float], edge: float) -> Layout:
        """For all pairs of these images: shards of one run find the same.

        Heights count from the sphere where the relief of the whole scene fits in steps that are fine enough for one crop,
        otherwise from each pair's own reference. heights : least and largest of the scene, m; edge : of a crop, m
        """
        whole, own = Packing.over(*heights), Packing.over(-edge / 2, edge / 2)
        relative = whole.step > own.step
        packings = {
            "elevation": own if relative else whole,
            "sun_horizon_deg": DEGREES,
            "emission_deg": DEGREES,
            "phase_deg": DEGREES,
        }
        if image := _image_packing(frames, units):
            packings["image"] = image
        return cls(packings, relative)

    def reference(self, elevation: NDArray[np.float32]) -> float:
        """The height that the elevations of one pair (h, w), m, count from: the middle of their range, in whole steps."""
        known = elevation[np.isfinite(elevation)]
        if not self.relative or not known.size:
            return 0.0
        step = self.packings["elevation"].step
        return step * round((float(known.min()) + float(known.max())) / 2 / step)


def _image_packing(frames: Sequence[Frame], units: str) -> Packing | None:
    """None for counts that are no whole numbers of 8 bits in the images: their scale is not known, or the step too wide."""
    if units == "iof":
        return IMAGE
    for frame in frames:
        with contextlib.suppress(InputError), rasters.open_raster(frame.path) as source:
            if source.dtypes[0] not in ("uint8", "int8") or source.scales[0] != 1 or source.offsets[0] != 0:
                return None
    return COUNTS


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

    def __init__(self, writer: ArtefactWriter, unit: str, layout: Layout, rays: bool, displaced: bool) -> None:
        self.layout, packings = layout, layout.packings
        units = {"elevation": None, "sun_horizon_deg": None, "image": unit}
        names = (*ALWAYS, *(DISPLACEMENT if displaced else ()), *(RAYS if rays else ()))
        self.sets = {name: writer.dataset(name, unit, packings.get(name)) for name, unit in units.items()}
        self.sets |= {name: writer.dataset(name, packing=packings.get(name)) for name in names}

    def put(self, k: int, pair: Pair, image_id: str) -> None:
        """Write one pair of an image. Raises InputError for values that do not fit."""
        reference = self.layout.reference(pair.elevation)
        values = {
            "image": np.where(pair.valid, pair.image, np.nan),
            "valid": pair.valid,
            "reference_elevation": reference,
            "elevation": pair.elevation - np.float32(reference),
            "sun_horizon_deg": np.degrees(pair.horizon),
            "sun_direction_enu": pair.sun,
            "camera_position_enu": pair.camera,
            "convergence_deg": pair.convergence_deg,
            **dict(zip(DISPLACEMENT, pair.displacement, strict=True)),
        }
        if pair.ortho is not None:
            ray = pair.ortho
            angles = (ray.detector_line, ray.detector_sample, np.degrees(ray.emission), np.degrees(ray.phase))
            values |= dict(zip(RAYS, angles, strict=True))
        for name, dataset in self.sets.items():
            if name in values:
                dataset[k] = pack(dataset, np.asarray(values[name]), f"image '{image_id}'")


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
