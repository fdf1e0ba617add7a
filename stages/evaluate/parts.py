"""The comparison in parts, each a file: what was fitted, and the scores of some crops. Together they give what one run gives."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas import atomic_path
from schemas.files.hdf5 import silence_hdf5
from stages.effects import load_extension
from stages.evaluate.core import PER_ROW, Scores, score
from stages.evaluate.fitting import choose_fit_pairs, dn_scale, fit_rows
from stages.evaluate.perceptual import Perceptual
from stages.evaluate.renderers import Constant
from stages.evaluate.rows import Row, make_renderers, make_rows
from stages.network.predictor import Predictor as Network
from stages.network.predictor import choose_device, load_predictor
from stages.pairs.reader import PairReader

COUNTS = ("pixels", "data_range", "within")


def write_fit(
    path: Path, pairs: Path, checkpoints: Sequence[Path], extend: Path | None, config: Any, wanted: np.ndarray
) -> None:
    """Fit what is free and write it as JSON: numbers survive that to the last bit."""
    with PairReader(pairs) as reader:
        rows = _rows(reader, checkpoints, extend, config)
        calibrated = reader.units == "iof"
        train, orphans = choose_fit_pairs(reader, wanted, config.fit_pairs, config.seed)
        everything = np.concatenate([train, orphans, wanted])
        scale = 1.0 if calibrated else dn_scale(reader, everything, config.batch)
        frames = len(reader.image_ids)
        fit_rows(reader, rows, train, orphans, frames, calibrated, scale, config.batch, config.seed)
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
    with atomic_path(path) as partial:
        partial.write_text(json.dumps({"scale": scale, "renderers": numbers}))


def read_fit(path: Path, rows: Sequence[Row]) -> float:
    """Set the renderers of ``rows`` to what was fitted; returns the DN scale."""
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


def load_predictors(checkpoints: Sequence[Path], device: str) -> list[Network]:
    """One for each training run."""
    return [load_predictor(path, choose_device(device)) for path in checkpoints]


def _rows(reader: PairReader, checkpoints: Sequence[Path], extend: Path | None, config: Any) -> list[Row]:
    predictors = load_predictors(checkpoints, config.device)
    extensions = load_extension(extend, reader.image_ids) if extend else []
    return make_rows(make_renderers(predictors, extensions), len(predictors), bool(extensions), config.only)


def write_scores(
    path: Path,
    pairs: Path,
    checkpoints: Sequence[Path],
    extend: Path | None,
    config: Any,
    fitted: Path,
    wanted: np.ndarray,
    renderings: bool,
) -> None:
    """Score every row on the crops ``wanted``."""
    silence_hdf5()
    with PairReader(pairs) as reader, atomic_path(path) as partial, h5py.File(partial, "w") as file:
        rows = _rows(reader, checkpoints, extend, config)
        scale = read_fit(fitted, rows)
        shape = (len(wanted), *reader.size)
        chunks = (1, *reader.size)
        measured = file.create_dataset("measured", shape, "f4", chunks=chunks)
        rendered: h5py.Dataset | None = None
        if renderings:
            rendered = file.create_dataset("rendered", (len(first_runs(rows)), *shape), "f4", chunks=(1, *chunks))

        def keep(position: int, crops: np.ndarray, images: list[np.ndarray]) -> None:
            measured[position : position + len(crops)] = crops
            if rendered is not None:
                for k, row in enumerate(first_runs(rows)):
                    rendered[k, position : position + len(crops)] = images[row]

        scores = score(reader, rows, wanted, scale, config.batch, Perceptual(), keep, lambda count: None)
        for name in (*PER_ROW, *COUNTS):
            file[name] = getattr(scores, name)


def first_runs(rows: Sequence[Row]) -> list[int]:
    """Where in ``rows`` each name's first training run stands: its renderings are kept and drawn."""
    return [k for k, row in enumerate(rows) if row.run == 0]


def join_scores(
    parts: Sequence[Path], rows: Sequence[Row], measured: h5py.Dataset, rendered: h5py.Dataset | None
) -> Scores:
    """The scores of all parts in their order; the crops go where they belong."""
    tables: dict[str, list[np.ndarray]] = {name: [] for name in (*PER_ROW, *COUNTS)}
    place = 0
    for part in parts:
        with h5py.File(part, "r") as file:
            for name, found in tables.items():
                found.append(file[name][...])
            count = file["measured"].shape[0]
            for k in range(count):
                measured[place + k] = file["measured"][k]
                if rendered is not None:
                    rendered[:, place + k] = file["rendered"][:, k]
            place += count
    joined: dict[str, Any] = {name: np.concatenate(found, axis=-1) for name, found in tables.items()}
    return Scores(names=[row.name for row in rows], **joined)
