"""Reading pairs.h5 for networks: batches of observations, images and masks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from schemas.artefacts import PAIRS, SPLITS
from schemas.errors import ArtefactError
from schemas.packing import decoder, read
from schemas.reading import open_artefact, read_strings, read_unit
from stages.common.memory import keep_freed_memory
from stages.pairs.holes import fill_holes
from stages.pairs.symmetries import turn_field, turn_vector
from stages.physics.formation.chain import Observation


@dataclass
class Batch:
    """The pairs that one step works on. image : (B, H, W) float32; valid : (B, H, W) bool"""

    observation: Observation
    image: Tensor
    valid: Tensor

    def to(self, device: torch.device) -> Batch:
        """The same on another device; the observation is moved in place."""
        o = self.observation
        for name, value in vars(o).items():
            if isinstance(value, Tensor):
                setattr(o, name, value.to(device, non_blocking=True))
        return Batch(o, self.image.to(device, non_blocking=True), self.valid.to(device, non_blocking=True))


FIELDS = ("elevation", "image", "valid", "sun_horizon_deg")
DETECTOR = ("detector_sample", "detector_line")


class _Maps:
    """A variable (pair, y, x), read pair by pair: one that was decoded lies in the processor's cache while it is copied."""

    def __init__(self, data: h5py.Dataset) -> None:
        self.data, self.decode = data, decoder(data)
        self.dtype = data.dtype if data.dtype == np.uint8 else np.dtype(np.float32)

    def read(self, wanted: NDArray[np.int64]) -> NDArray:
        """(B, H, W): flags as they are, all else float32, NaN where unknown."""
        found = np.empty((len(wanted), *self.data.shape[1:]), self.dtype)
        for place, k in enumerate(wanted.tolist()):
            found[place] = self.decode(self.data[k])
        return found


class PairReader:
    """Random access to pairs.h5, whichever program wrote it and however it is laid out.

    split, tile, frame, site : (n,) arrays; image_ids : one per frame; units : 'iof' or 'dn'; gsd, body_radius : m
    detector : whether observations hold each pixel's place on the sensor
    """

    def __init__(self, path: Path, detector: bool = True) -> None:
        self.path = Path(path)
        self.file: h5py.File = open_artefact(self.path, PAIRS)
        f = self.file
        keep_freed_memory()  # page faults of new arrays would cost as much as reading
        self._maps = {name: _Maps(f[name]) for name in FIELDS + (DETECTOR if detector else ()) if name in f}
        self.size: tuple[int, int] = f["elevation"].shape[1:]
        self.count: int = f["elevation"].shape[0]
        if not self.count:
            raise ArtefactError(f"{path}: expected pairs, found none; sample more crops.")
        self.gsd = float(f.attrs["gsd_m"])
        self.body_radius = float(f.attrs["body_radius_m"])
        self.units = "dn" if read_unit(f["image"]) == "dn" else "iof"
        self.split = f["split"][...].astype(np.int64)
        self.frame = f["image_index"][...].astype(np.int64)
        self.site = f["site"][...].astype(np.int64)
        self.tile = f["tile"][...].astype(np.int64) if "tile" in f else self.site
        self._sun, self._camera = (
            read(f[n], ...).astype(np.float32) for n in ("sun_direction_enu", "camera_position_enu")
        )
        self._reference = read_reference(f).astype(np.float32)
        self.image_ids = read_strings(f, "image_id")
        bands = f["wavelength_nm"][...] if "wavelength_nm" in f else np.zeros(0)
        known = bands[np.isfinite(bands)]
        self.wavelength_nm = float(np.median(known)) if known.size else math.nan  # of the images' band
        if not (np.linalg.norm(self._camera, axis=1) > 0).all():
            raise ArtefactError(
                f"{path}:/camera_position_enu: expected places away from the crop, found 0; write it again."
            )
        self._check_any_valid()

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __enter__(self) -> PairReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_any_valid(self) -> None:
        """Refuse a file without a valid pixel; of good files only the first pair is read. Raises ArtefactError."""
        for index in range(self.count):
            if _validity(self._read(["valid", "image", "elevation"], [index])).any():
                return
        raise ArtefactError(
            f"{self.path}: expected valid pixels, found none in any pair (valid = 0, or images or elevations unknown); "
            "write it again with 'lunargr project'."
        )

    def indices(self, part: str) -> NDArray[np.int64]:
        """Pairs of 'train', 'validation' or 'test'."""
        return np.flatnonzero(self.split == dict(SPLITS)[part])

    def _read(self, names: Iterable[str], indices: Sequence[int] | NDArray) -> dict[str, NDArray]:
        """Variables of some pairs, (B, H, W) each: float32 with NaN where unknown, or flags."""
        wanted = np.asarray(indices, dtype=np.int64)
        try:
            found = {name: self._maps[name].read(wanted) for name in names if name in self._maps}
        except OSError as error:
            raise ArtefactError(
                f"{self.path}: cannot be read to the end ({error}); the file is damaged or truncated, write it again."
            ) from None
        if "elevation" in found:
            found["elevation"] += self._reference[wanted, None, None]
        return found

    def known_elevation(self, indices: Sequence[int] | NDArray) -> NDArray[np.float32]:
        """(B, H, W) m, NaN = unknown. indices : (B,)"""
        return self._read(["elevation"], indices)["elevation"]

    def elevation(self, indices: Sequence[int] | NDArray) -> Tensor:
        """(B, H, W) float32 m; holes are filled from their surroundings."""
        return torch.from_numpy(_without_holes(self.known_elevation(indices)))

    def observation(self, indices: Sequence[int] | NDArray) -> Observation:
        """The terrain, Sun and camera of these pairs. indices : (B,)"""
        names = [n for n in self._maps if n not in ("image", "valid")]
        return self._observation(self._read(names, indices), indices)

    def _observation(self, found: dict[str, NDArray], indices: Sequence[int] | NDArray) -> Observation:
        def optional(name: str) -> Tensor | None:
            return torch.from_numpy(found[name]) if name in found else None

        horizon = found.get("sun_horizon_deg")
        if horizon is not None:
            _replace_unknown(horizon, -90.0)
            horizon *= np.float32(math.pi / 180)
        rows = np.asarray(indices)
        return Observation(
            elevation=torch.from_numpy(_without_holes(found["elevation"])),
            sun_direction=torch.from_numpy(self._sun[rows]),
            camera_position=torch.from_numpy(self._camera[rows]),
            gsd=self.gsd,
            body_radius=self.body_radius,
            sun_horizon=optional("sun_horizon_deg"),
            detector_sample=optional("detector_sample"),
            detector_line=optional("detector_line"),
            frame=torch.from_numpy(self.frame[rows]),
        )

    def image(self, indices: Sequence[int] | NDArray) -> Tensor:
        """(B, H, W) float32; 0 where invalid."""
        return torch.from_numpy(_replace_unknown(self._read(["image"], indices)["image"], 0.0))

    def valid(self, indices: Sequence[int] | NDArray) -> Tensor:
        """(B, H, W) bool: DEM and image both valid and finite."""
        return torch.from_numpy(_validity(self._read(["valid", "image", "elevation"], indices)))

    def batch(self, indices: Sequence[int] | NDArray, symmetries: NDArray | None = None) -> Batch:
        """A batch. indices : (B,); symmetries : (B,), of the square (0 .. 7), under which each pair is turned"""
        found = self._read(self._maps, indices)
        valid = torch.from_numpy(_validity(found))
        image = torch.from_numpy(_replace_unknown(found["image"], 0.0))
        batch = Batch(self._observation(found, indices), image, valid)
        if symmetries is not None:
            _turn(batch, symmetries)
        return batch


def read_reference(file: h5py.File) -> NDArray[np.float64]:
    """(pair,) m, height above the sphere that each pair's elevations count from: 0 where an open file has none."""
    if "reference_elevation" in file:
        return np.nan_to_num(read(file["reference_elevation"], ...)).astype(np.float64)
    return np.zeros(file["elevation"].shape[0])


def _all_known(values: NDArray) -> bool:
    return bool(np.isfinite(values.sum()))


def _replace_unknown(values: NDArray, by: float) -> NDArray:
    """In place."""
    if not _all_known(values):
        np.nan_to_num(values, copy=False, nan=by, posinf=by, neginf=by)
    return values


def _validity(found: dict[str, NDArray]) -> NDArray[np.bool_]:
    flag = found["valid"] > 0.5
    for name in ("image", "elevation"):
        if not _all_known(found[name]):
            flag &= np.isfinite(found[name])
    return flag


def _without_holes(elevation: NDArray[np.float32]) -> NDArray[np.float32]:
    if not _all_known(elevation):
        finite = np.isfinite(elevation)
        for k in np.flatnonzero(~finite.all(axis=(1, 2))):
            elevation[k] = fill_holes(elevation[k], finite[k])
    return elevation


def _turn(batch: Batch, symmetries: NDArray) -> None:
    o = batch.observation
    fields = [batch.image, batch.valid, o.elevation]
    fields += [f for f in (o.sun_horizon, o.detector_sample, o.detector_line) if f is not None]
    for k, symmetry in enumerate(symmetries):
        if symmetry:
            for field in fields:
                field[k] = turn_field(field[k].clone(), int(symmetry))
            o.sun_direction[k] = turn_vector(o.sun_direction[k].clone(), int(symmetry))
            o.camera_position[k] = turn_vector(o.camera_position[k].clone(), int(symmetry))
