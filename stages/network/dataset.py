"""Reading pairs.h5 for networks: batches of observations, images and masks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from schemas.artefacts import PAIRS, SPLITS
from schemas.errors import ArtefactError
from schemas.hdf5 import open_artefact, read_strings
from stages.network.normalisation import fill_holes
from stages.network.symmetries import turn_field, turn_vector
from stages.physics.formation import Observation


@dataclass
class Batch:
    """What one step works on: ``image`` and ``valid`` are (B, H, W), float32 and bool."""

    observation: Observation
    image: Tensor
    valid: Tensor

    def to(self, device: torch.device) -> Batch:
        o = self.observation
        for name in (
            "elevation",
            "sun_direction",
            "camera_position",
            "sun_horizon",
            "sky_view",
            "detector_sample",
            "detector_line",
            "frame",
        ):
            value = getattr(o, name)
            setattr(o, name, None if value is None else value.to(device, non_blocking=True))
        return Batch(o, self.image.to(device, non_blocking=True), self.valid.to(device, non_blocking=True))


class PairReader:
    """Random access to pairs.h5, one HDF5 chunk per pair and variable.

    split, tile, frame, site : (n,) arrays; image_ids : one per frame; units : 'iof' or 'dn'; gsd, body_radius : m
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.file: h5py.File = open_artefact(self.path, PAIRS)
        f = self.file
        self.size: tuple[int, int] = f["elevation"].shape[1:]
        self.count: int = f["elevation"].shape[0]
        if not self.count:
            raise ArtefactError(f"{path}: expected pairs, found none; sample more crops.")
        self.gsd = float(f.attrs["gsd_m"])
        self.body_radius = float(f.attrs["body_radius_m"])
        unit = f["image"].attrs.get("units", "1")
        self.units = "dn" if (unit.decode() if isinstance(unit, bytes) else str(unit)) == "dn" else "iof"
        self.split = f["split"][...].astype(np.int64)
        self.frame = f["image_index"][...].astype(np.int64)
        self.site = f["site"][...].astype(np.int64)
        self.tile = f["tile"][...].astype(np.int64) if "tile" in f else self.site
        self.image_ids = read_strings(f, "image_id")
        if self.frame.min() < 0 or self.frame.max() >= len(self.image_ids):
            raise ArtefactError(
                f"{path}:/image_index: expected indices below {len(self.image_ids)} (frames), found {self.frame.max()}."
            )

    def close(self) -> None:
        self.file.close()

    def __enter__(self) -> PairReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def indices(self, part: str) -> NDArray[np.int64]:
        """Pairs of 'train', 'validation' or 'test'."""
        return np.flatnonzero(self.split == dict(SPLITS)[part])

    def _fields(self, name: str, indices: Sequence[int] | NDArray) -> NDArray[np.float32]:
        data = self.file[name]
        out = np.empty((len(indices), *data.shape[1:]), np.float32)
        for k, index in enumerate(indices):
            out[k] = data[int(index)]
        return out

    def elevation(self, indices: Sequence[int] | NDArray) -> Tensor:
        """(B, H, W) float32 m; holes are filled from their surroundings."""
        out = self._fields("elevation", indices)
        finite = np.isfinite(out)
        if not finite.all():
            for k in np.flatnonzero(~finite.all(axis=(1, 2))):
                out[k] = fill_holes(out[k], finite[k])
        return torch.from_numpy(out)

    def observation(self, indices: Sequence[int] | NDArray) -> Observation:
        """Everything about these pairs but their images."""

        def optional(name: str) -> Tensor | None:
            return torch.from_numpy(self._fields(name, indices)) if name in self.file else None

        horizon = optional("sun_horizon_deg")
        if horizon is not None:
            horizon = torch.nan_to_num(horizon, nan=-90.0) * (math.pi / 180)
        rows = np.asarray(indices)
        return Observation(
            elevation=self.elevation(indices),
            sun_direction=torch.from_numpy(self._fields("sun_direction_enu", rows)),
            camera_position=torch.from_numpy(self._fields("camera_position_enu", rows)),
            gsd=self.gsd,
            body_radius=self.body_radius,
            sun_horizon=horizon,
            sky_view=optional("sky_view"),
            detector_sample=optional("detector_sample"),
            detector_line=optional("detector_line"),
            frame=torch.from_numpy(self.frame[rows]),
        )

    def image(self, indices: Sequence[int] | NDArray) -> Tensor:
        """(B, H, W) float32; 0 where invalid."""
        return torch.from_numpy(np.nan_to_num(self._fields("image", indices), nan=0.0, posinf=0.0, neginf=0.0))

    def valid(self, indices: Sequence[int] | NDArray) -> Tensor:
        """(B, H, W) bool: DEM and image both valid and finite."""
        flag = self._fields("valid", indices) > 0.5
        flag &= np.isfinite(self._fields("image", indices)) & np.isfinite(self._fields("elevation", indices))
        return torch.from_numpy(flag)

    def batch(self, indices: Sequence[int] | NDArray, symmetries: NDArray | None = None) -> Batch:
        """A batch, each pair under its own symmetry of the square where given."""
        batch = Batch(self.observation(indices), self.image(indices), self.valid(indices))
        if symmetries is not None:
            _turn(batch, symmetries)
        return batch


def _turn(batch: Batch, symmetries: NDArray) -> None:
    o = batch.observation
    fields = [batch.image, batch.valid, o.elevation]
    fields += [f for f in (o.sun_horizon, o.sky_view, o.detector_sample, o.detector_line) if f is not None]
    for k, symmetry in enumerate(symmetries):
        if symmetry:
            for field in fields:
                field[k] = turn_field(field[k].clone(), int(symmetry))
            o.sun_direction[k] = turn_vector(o.sun_direction[k].clone(), int(symmetry))
            o.camera_position[k] = turn_vector(o.camera_position[k].clone(), int(symmetry))
