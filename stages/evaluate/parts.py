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
from stages.evaluate.core import Row, Scores, choose_fit_pairs, dn_scale, fit_renderers, layout, make_renderers, score
from stages.evaluate.perceptual import Perceptual
from stages.evaluate.renderers import Constant, Predictor
from stages.network.predictor import choose_device, load_predictor
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Extension

TABLES = ("squared_error", "ssim", "ssim_range_1", "lpips")
COUNTS = ("pixels", "data_range")


def write_fit(path: Path, pairs: Path, checkpoint: Path, extend: Path | None, config: Any, wanted: np.ndarray) -> None:
    """Fit what is free and write it as JSON: numbers survive that to the last bit."""
    with PairReader(pairs) as reader:
        predictor = load_predictor(checkpoint, choose_device(config.device))
        extensions = load_extension(extend, reader.image_ids) if extend else []
        calibrated = reader.units == "iof"
        train, orphans = choose_fit_pairs(reader, wanted, config.fit_pairs, config.seed)
        everything = np.concatenate([train, orphans, wanted])
        scale = 1.0 if calibrated else dn_scale(reader, everything, config.batch)
        orphans = np.empty(0, int) if calibrated else orphans
        rows = fit_renderers(
            reader, predictor, extensions, train, orphans, len(reader.image_ids), calibrated, scale, config.batch,
            config.seed, lambda count: None, config.only,
        )  # fmt: skip
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


def read_fit(
    path: Path, predictor: Predictor, extensions: Sequence[Extension], only: Sequence[str]
) -> tuple[list[Row], float]:
    """The rows of the table as they were fitted, and the DN scale."""
    found = json.loads(path.read_text())
    start = np.array([p.default for p in predictor.model.parameters])
    renderers = make_renderers(predictor, extensions, start)
    for name, numbers in found["renderers"].items():
        renderer = renderers[name]
        if numbers["coefficients"] is not None:
            renderer.coefficients = Constant(np.array(numbers["coefficients"]))
        renderer.scale = numbers["scale"]
        renderer.gain, renderer.offset = (
            None if numbers[k] is None else np.array(numbers[k]) for k in ("gain", "offset")
        )
    rows = [Row(n, renderers[source], how) for n, source, how in layout(bool(extensions)) if not only or n in only]
    return rows, float(found["scale"])


def write_scores(
    path: Path,
    pairs: Path,
    checkpoint: Path,
    extend: Path | None,
    config: Any,
    fitted: Path,
    wanted: np.ndarray,
    renderings: bool,
) -> None:
    """Score every row on the crops ``wanted``."""
    silence_hdf5()
    with PairReader(pairs) as reader, atomic_path(path) as partial, h5py.File(partial, "w") as file:
        predictor = load_predictor(checkpoint, choose_device(config.device))
        extensions = load_extension(extend, reader.image_ids) if extend else []
        rows, scale = read_fit(fitted, predictor, extensions, config.only)
        shape = (len(wanted), *reader.size)
        chunks = (1, *reader.size)
        measured = file.create_dataset("measured", shape, "f4", chunks=chunks)
        rendered: h5py.Dataset | None = None
        if renderings:
            rendered = file.create_dataset("rendered", (len(rows), *shape), "f4", chunks=(1, *chunks))

        def keep(position: int, crops: np.ndarray, images: list[np.ndarray]) -> None:
            measured[position : position + len(crops)] = crops
            if rendered is not None:
                for k, image in enumerate(images):
                    rendered[k, position : position + len(crops)] = image

        scores = score(reader, rows, wanted, scale, config.batch, Perceptual(), keep, lambda count: None)
        for name in (*TABLES, *COUNTS):
            file[name] = getattr(scores, name)


def join_scores(
    parts: Sequence[Path], rows: Sequence[Row], measured: h5py.Dataset, rendered: h5py.Dataset | None
) -> Scores:
    """The scores of all parts in their order; the crops go where they belong."""
    tables: dict[str, list[np.ndarray]] = {name: [] for name in (*TABLES, *COUNTS)}
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
