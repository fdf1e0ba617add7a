"""The ground that a network learned from, as its checkpoint and the maps made with it record it.

Ground that a network learned from is not scored: two samples of one scene may split it differently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas import SPLITS, ArtefactError, ArtefactWriter, open_artefact, read_kind
from schemas.provenance import read_record
from stages.common.arrays import Floats
from stages.pairs.reader import PairReader
from stages.physics.maps.grid import unit_vectors

EDGE = "ground_edge_m"
COLUMNS = ("ground_longitude_deg", "ground_latitude_deg", "ground_split")
SLACK = 0.02  # of an edge: pixels of a map are a few per cent off the nominal size
BODY_TOLERANCE = 0.005  # of the radius: what differs more is another body


@dataclass(frozen=True)
class Ground:
    """Square crops of training (split 0) and validation (1): centres (n,) deg, split (n,), edge m."""

    longitude_deg: Floats
    latitude_deg: Floats
    split: NDArray[np.uint8]
    edge: float

    @classmethod
    def of(cls, reader: PairReader) -> Ground:
        """What a network learns from that is trained on these pairs."""
        learned = np.concatenate([reader.indices("train"), reader.indices("validation")])
        lon, lat = (reader.file[name][...][learned] for name in ("longitude_deg", "latitude_deg"))
        places = np.unique(np.stack([lon, lat, reader.split[learned]], axis=1), axis=0)
        return cls(places[:, 0], places[:, 1], places[:, 2].astype(np.uint8), _edge(reader))

    @classmethod
    def read(cls, file: h5py.File) -> Ground | None:
        """From an open checkpoint or map; None where it holds no such record."""
        if EDGE not in file.attrs or any(name not in file for name in COLUMNS):
            return None
        lon, lat, split = (file[name][...] for name in COLUMNS)
        return cls(lon, lat, split, float(file.attrs[EDGE]))

    @property
    def sizes(self) -> dict[str, int]:
        """The dimension that the record needs."""
        return {"place": len(self.split)}

    @property
    def attributes(self) -> dict[str, Any]:
        """Root attributes of the record."""
        return {EDGE: self.edge}

    def write(self, writer: ArtefactWriter) -> None:
        """Write the columns of the record."""
        for name, values in zip(COLUMNS, (self.longitude_deg, self.latitude_deg, self.split), strict=True):
            writer.write(name, values)


def leave_out_learned(
    reader: PairReader, wanted: NDArray[np.int64], learner: Path, split: str
) -> tuple[NDArray[np.int64], list[str]]:
    """The ``wanted`` pairs (N,) whose ground a network did not learn from, and notes on what is left out or not known.

    learner : its checkpoint, or a map made with it; split : which part the pairs are scored as: of 'test' pairs ground of
    training and validation is left out, of 'validation' pairs ground of training, of 'train' pairs nothing.
    Raises ArtefactError where no pair is left.
    """
    rank = dict(SPLITS)[split]
    with open_artefact(learner, read_kind(learner)) as file:
        ground, radius = Ground.read(file), float(file.attrs["body_radius_m"])
    mine, theirs = splits_of(reader.path), splits_of(learner)
    ids = {s["split_id"] for s in mine}, {s["split_id"] for s in theirs}
    if ids[0] == ids[1] and len(ids[0]) == 1 and (reader.split[wanted] == rank).all():
        return wanted, []  # one split of one scene: its parts share no ground
    if ground is None:
        known = mine and theirs
        boxes = [(m["split_ground_deg"], t["split_ground_deg"]) for m in mine for t in theirs]
        if not rank or (known and not any(boxes_overlap(*pair) for pair in boxes)):
            return wanted, []
        return wanted, [
            f"{learner.name} does not record the ground that it was trained on: {split} pairs on that ground are not left out"
        ]
    if abs(radius / reader.body_radius - 1) > BODY_TOLERANCE:
        return wanted, []
    shared = _shared(reader, wanted, ground, rank)
    if len(wanted) and shared.all():
        raise ArtefactError(
            f"{reader.path}: expected '{split}' pairs on ground that {learner.name} did not learn from, found none; "
            "sample with the `tile_m`, `split` and `seed` of its training, or train on these pairs."
        )
    note = f"{shared.sum()} of {len(wanted)} {split} pairs are left out: {learner.name} learned from their ground"
    return wanted[~shared], [note] if shared.any() else []


def _edge(reader: PairReader) -> float:
    """m; of crops that are not square, the longer one."""
    return max(reader.size) * reader.gsd


def _shared(reader: PairReader, wanted: NDArray[np.int64], ground: Ground, rank: int) -> NDArray[np.bool_]:
    """(N,) whether a crop overlaps ground of a lower split than ``rank``."""
    file, earlier = reader.file, ground.split < rank
    lon, lat = (file[name][...][wanted] for name in ("longitude_deg", "latitude_deg"))
    turn = np.radians(file["convergence_deg"][...][wanted]) if "convergence_deg" in file else np.zeros(len(wanted))
    up = unit_vectors(lon, lat)
    east = unit_vectors(lon + 90.0, np.zeros_like(lat))
    north = np.cross(up, east)
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    axes = np.stack([east * cos + north * sin, north * cos - east * sin], axis=1)
    places = reader.body_radius * unit_vectors(ground.longitude_deg[earlier], ground.latitude_deg[earlier])
    reach = (_edge(reader) + ground.edge) / 2 * (1 - SLACK)
    shared = np.zeros(len(wanted), bool)
    if not len(places):
        return shared
    centres = reader.body_radius * up
    for k, near in enumerate(cKDTree(places).query_ball_point(centres, np.sqrt(2) * reach)):
        shared[k] = (np.abs((places[near] - centres[k]) @ axes[k].T).max(axis=1, initial=0.0) < reach).any()
    return shared


def splits_of(path: Path) -> list[dict[str, Any]]:
    """What the samples that an artefact descends from say of their splits."""
    own, ancestors = read_record(Path(path))
    records = [*([own] if own else []), *ancestors.values()]
    return [r["config"] for r in records if r["schema"] == "crops" and "split_id" in r["config"]]


def boxes_overlap(first: Sequence[float], second: Sequence[float]) -> bool:
    """Whether two boxes (west, east, south, north; degrees) share ground."""
    (w1, e1, s1, n1), (w2, e2, s2, n2) = first, second
    turned = round((w1 - w2) / 360) * 360
    return w1 < e2 + turned and w2 + turned < e1 and s1 < n2 and s2 < n1
