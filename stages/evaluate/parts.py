"""The comparison in parts, each a file: what was fitted, and the scores of some crops. Together they give what one run gives."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas import write_json
from schemas.files.hdf5 import whole_hdf5
from stages.evaluate.config import Config
from stages.evaluate.fitting import fit_rows
from stages.evaluate.renderers import Constant
from stages.evaluate.rows import Row
from stages.evaluate.scores import PER_ROW, Scores, score
from stages.evaluate.task import Task, make_task
from stages.pairs.reader import PairReader

# (what, function, its arguments for every part, suffix) -> the parts that function(path, **arguments) wrote, in order
Fan = Callable[[str, Callable[..., Any], Sequence[Mapping[str, Any]], str], list[Path]]
COUNTS = ("pixels", "data_range", "within")
PART_BATCHES = 32


@dataclass(frozen=True)
class Kept:
    """The crops that are kept. first : rows whose renderings they are, where there are any"""

    measured: h5py.Dataset
    rendered: h5py.Dataset | None
    first: Sequence[int]

    def put(self, position: int, crops: np.ndarray, images: list[np.ndarray]) -> None:
        """crops : (B, H, W) from ``position`` on; images : the same of every row"""
        self.measured[position : position + len(crops)] = crops
        if self.rendered is not None:
            for k, row in enumerate(self.first):
                self.rendered[k, position : position + len(crops)] = images[row]


def score_in_parts(
    task: Task, pairs: Path, checkpoints: Sequence[Path], fan: Fan, kept: Kept
) -> tuple[list[Row], Scores, float]:
    """Fit once, then score some crops in every part. Returns rows, their scores, and the full range of DN."""
    config = task.config
    if config.extend:
        config = replace(config, extend=str(Path(config.extend).resolve()))
    shared: dict[str, Any] = {"pairs": pairs, "checkpoints": checkpoints, "config": config}
    [fitted] = fan("fit", write_fit, [shared | {"wanted": task.wanted}], ".json")
    rows = task.rows()
    scale = read_fit(fitted, rows)
    step = PART_BATCHES * config.batch  # whole batches: the network sees the same ones whatever the parts
    todo = [
        shared | {"fitted": fitted, "wanted": task.wanted[k : k + step], "renderings": kept.rendered is not None}
        for k in range(0, len(task.wanted), step)
    ]
    return rows, join_scores(fan("scores", write_scores, todo, ".h5"), rows, kept), scale


def write_fit(path: Path, pairs: Path, checkpoints: Sequence[Path], config: Config, wanted: np.ndarray) -> None:
    """Fit what is free and write it as JSON: numbers survive that to the last bit. wanted : indices of the scored pairs (N,)"""
    with PairReader(pairs) as reader:
        task = make_task(reader, checkpoints, wanted, config)
        rows, fitting = task.rows(), task.fitting()
        fit_rows(fitting, rows)
    numbers = {
        row.renderer.name: {
            "coefficients": row.renderer.coefficients.values.tolist()
            if isinstance(row.renderer.coefficients, Constant)
            else None,
            "scale": row.renderer.scale,
            "gain": None if row.renderer.gain is None else row.renderer.gain.tolist(),
            "offset": None if row.renderer.offset is None else row.renderer.offset.tolist(),
        }
        for row in rows
    }
    write_json(path, {"scale": fitting.scale, "renderers": numbers})


def read_fit(path: Path, rows: Sequence[Row]) -> float:
    """Set the renderers of ``rows`` to what was fitted; returns the full range of DN."""
    found = json.loads(path.read_text())
    for row in rows:
        renderer, numbers = row.renderer, found["renderers"][row.renderer.name]
        if numbers["coefficients"] is not None:
            renderer.coefficients = Constant(np.array(numbers["coefficients"]))
        renderer.scale = numbers["scale"]
        renderer.gain, renderer.offset = (
            None if numbers[k] is None else np.array(numbers[k]) for k in ("gain", "offset")
        )
    return float(found["scale"])


def write_scores(
    path: Path,
    pairs: Path,
    checkpoints: Sequence[Path],
    config: Config,
    fitted: Path,
    wanted: np.ndarray,
    renderings: bool,
) -> None:
    """Score every row on the crops ``wanted`` (n,) and write the scores and the crops; fitted : from :func:`write_fit`."""
    with PairReader(pairs) as reader, whole_hdf5(path) as file:
        rows = make_task(reader, checkpoints, wanted, config).rows()
        scale = read_fit(fitted, rows)
        shape, first = (len(wanted), *reader.size), first_runs(rows)
        chunks = (1, *reader.size)
        measured = file.create_dataset("measured", shape, "f4", chunks=chunks)
        rendered: h5py.Dataset | None = None
        if renderings:
            rendered = file.create_dataset("rendered", (len(first), *shape), "f4", chunks=(1, *chunks))
        scores = score(reader, rows, wanted, scale, config.batch, Kept(measured, rendered, first).put)
        for name in (*PER_ROW, *COUNTS):
            file[name] = getattr(scores, name)


def first_runs(rows: Sequence[Row]) -> list[int]:
    """Where in ``rows`` each name's first training run stands: its renderings are kept and drawn."""
    return [k for k, row in enumerate(rows) if row.run == 0]


def join_scores(parts: Sequence[Path], rows: Sequence[Row], kept: Kept) -> Scores:
    """The scores of all parts in their order; the crops go where they belong."""
    tables: dict[str, list[np.ndarray]] = {name: [] for name in (*PER_ROW, *COUNTS)}
    place = 0
    for part in parts:
        with h5py.File(part, "r") as file:
            for name, found in tables.items():
                found.append(file[name][...])
            count = file["measured"].shape[0]
            for k in range(count):
                kept.measured[place + k] = file["measured"][k]
                if kept.rendered is not None:
                    kept.rendered[:, place + k] = file["rendered"][:, k]
            place += count
    joined: dict[str, Any] = {name: np.concatenate(found, axis=-1) for name, found in tables.items()}
    return Scores(names=[row.name for row in rows], **joined)
