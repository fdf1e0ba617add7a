"""From files to files: pairs and checkpoint in, table, JSON, evaluation artefact and figures out."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas import (
    CHECKPOINT,
    EVALUATION,
    SPLITS,
    ArtefactError,
    ArtefactWriter,
    ConfigError,
    RegistryError,
    atomic_path,
    check_output,
    open_artefact,
    read_config,
)
from schemas.files.companions import companions_of
from stages.effects import load_extension
from stages.evaluate.bootstrap import TileBootstrap
from stages.evaluate.core import TITLES, Row, Scores, choose_fit_pairs, dn_scale, fit_renderers, layout, score
from stages.evaluate.parts import join_scores, read_fit, write_fit, write_scores
from stages.evaluate.perceptual import Perceptual
from stages.evaluate.renderers import Predictor, Reader
from stages.evaluate.table import gain_table, metric_table
from stages.network.predictor import Predictor as Network
from stages.network.predictor import choose_device, load_predictor
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Extension

RENDERINGS_LIMIT = 512 * 2**20  # bytes of rendered crops that are kept without being asked for
MANY_TILES = 10  # fewer make percentile intervals too narrow


# (what, function, its arguments for every part, suffix) -> the parts that function(path, **arguments) wrote, in order
Fan = Callable[[str, Callable[..., Any], Sequence[Mapping[str, Any]], str], list[Path]]
PART_BATCHES = 32


@dataclass
class Config:
    """Options of evaluate; ``fit_pairs`` bounds the pairs that baselines are fitted on (0: all); ``only``: these rows."""

    split: str = "test"
    batch: int = 16
    bootstrap: int = 2000
    fit_pairs: int = 4096
    renderings: bool | None = None
    seed: int = 0
    device: str = "auto"
    only: tuple[str, ...] = ()


def run(
    pairs: Path,
    checkpoint: Path,
    output: Path,
    config: Config,
    *,
    extend: Path | None = None,
    json_file: Path | None = None,
    figures: Path | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
    fan: Fan | None = None,
) -> dict[str, Any]:
    """Evaluate a checkpoint on a split of a pairs file; returns what the JSON holds.

    ``fan`` has the crops scored in parts, wherever it works on them.

    Writes ``output`` (evaluation artefact), the JSON beside it (and at ``json_file``), and figures where asked.
    Raises ConfigError or ArtefactError before anything is written.
    """
    inputs = [pairs, checkpoint, *([extend] if extend else [])]
    reports = [output.with_suffix(".json"), *([json_file] if json_file else [])]
    check_output(output, inputs, overwrite)
    for report in reports:
        check_output(report, [*inputs, output], overwrite)
    _check(config)
    device = choose_device(config.device)
    with PairReader(pairs) as reader:
        wanted = select(reader, config.split)
        predictor = load_predictor(checkpoint, device)
        if reader.units == "iof" and predictor.image_units == "dn":
            raise ArtefactError(
                f"{checkpoint}: expected a checkpoint trained on I/F images as in {pairs.name}, found one trained on "
                "DN, whose brightness scale is arbitrary; train on these pairs."
            )
        extensions = load_extension(extend, reader.image_ids) if extend else []
        notes = _notes(checkpoint, predictor.gsd, reader.gsd, extend)
        return _evaluate(
            reader,
            predictor,
            extensions,
            wanted,
            config,
            notes,
            inputs,
            output,
            reports,
            figures,
            overwrite,
            progress,
            fan,
        )


def _check(config: Config) -> None:
    if config.split not in dict(SPLITS):
        raise ConfigError(f"--split: expected one of {', '.join(dict(SPLITS))}, found '{config.split}'.")
    if config.batch < 1 or config.bootstrap < 0 or config.fit_pairs < 0:
        raise ConfigError(
            "--batch, --bootstrap, --fit-pairs: expected at least 1, 0 and 0, "
            f"found {config.batch}, {config.bootstrap} and {config.fit_pairs}."
        )


def select(reader: PairReader, split: str) -> np.ndarray:
    """Indices of the split's pairs. Raises ArtefactError where there are none, or none to fit the baselines on."""
    counts = ", ".join(f"{name} {int((reader.split == value).sum())}" for name, value in SPLITS)
    for part, purpose in ((split, "to evaluate"), ("train", "to fit the baselines on")):
        if not len(reader.indices(part)):
            raise ArtefactError(
                f"{reader.path}:/split: expected '{part}' pairs {purpose}, found none ({counts}); sample more crops."
            )
    return reader.indices(split)


def _notes(checkpoint: Path, trained_gsd: float, gsd: float, extend: Path | None) -> list[str]:
    notes = []
    if abs(trained_gsd / gsd - 1) > 0.01:
        notes.append(f"the checkpoint was trained at {trained_gsd:g} m per pixel, these pairs have {gsd:g} m")
    with open_artefact(checkpoint, CHECKPOINT) as file:
        trained_with = read_config(file).get("extend")
    if trained_with and extend is None:
        notes.append(f"the checkpoint was trained with the effects of '{Path(trained_with).name}': add --extend")
    return notes


def evaluate_pairs(
    reader: Reader,
    predictor: Predictor,
    wanted: np.ndarray,
    frame_names: list[str],
    units: str,
    config: Config,
    *,
    extensions: Sequence[Extension] = (),
    keep: Callable[[int, np.ndarray, list[np.ndarray]], Any] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> tuple[dict[str, Any], list[Row], Any, float]:
    """The pure comparison: (what the JSON holds, rows, scores, DN scale)."""
    calibrated = units == "iof"
    train, orphans = choose_fit_pairs(reader, wanted, config.fit_pairs, config.seed)
    total = len(train) + len(orphans) + len(wanted)
    done = 0

    def tick(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, total, "evaluate")

    if progress is not None:
        progress(0, total, "evaluate")
    scale = 1.0 if calibrated else dn_scale(reader, np.concatenate([train, orphans, wanted]), config.batch)
    orphans = np.empty(0, int) if calibrated else orphans
    total = len(train) + len(orphans) + len(wanted)
    rows = fit_renderers(
        reader, predictor, extensions, train, orphans, len(frame_names), calibrated, scale, config.batch, config.seed,
        tick, config.only,
    )  # fmt: skip
    scores = score(reader, rows, wanted, scale, config.batch, Perceptual(), keep, tick)
    return conclude(reader, predictor, wanted, frame_names, units, config, rows, scores, scale), rows, scores, scale


def conclude(
    reader: Reader,
    predictor: Predictor,
    wanted: np.ndarray,
    frame_names: list[str],
    units: str,
    config: Config,
    rows: list[Row],
    scores: Scores,
    scale: float,
) -> dict[str, Any]:
    """What the JSON holds."""
    calibrated = units == "iof"
    train, orphans = choose_fit_pairs(reader, wanted, config.fit_pairs, config.seed)
    orphans = np.empty(0, int) if calibrated else orphans
    perceptual = Perceptual()
    if not scores.pixels.any():
        raise ArtefactError(f"split '{config.split}': expected valid pixels, found none; project the pairs again.")
    tile = np.asarray(reader.tile)[wanted]
    unit = "tile"
    if len(np.unique(tile)) == 1:  # better a flagged interval over crop sites than none
        unit, tile = "site", np.asarray(reader.site)[wanted]
    bootstrap = TileBootstrap(tile, config.bootstrap, config.seed)
    frames = np.asarray(reader.frame)
    return {
        "split": config.split,
        "models": metric_table(scores, bootstrap),
        "gains": gain_table(scores, bootstrap),
        "titles": {row.name: TITLES[row.name] for row in rows},
        "pairs": len(wanted),
        "valid_pixels": int(scores.pixels.sum()),
        "tiles": len(np.unique(np.asarray(reader.tile)[wanted])),
        "bootstrap_unit": unit,
        "bootstrap": config.bootstrap,
        "image_units": units,
        "dn_full_range": None if calibrated else scale,
        "model": predictor.model.name,
        "fitted_on_pairs": len(train),
        "frames_fitted_on_split": sorted({frame_names[f] for f in frames[orphans]}),
        "lpips_unavailable": None if perceptual.available else perceptual.reason,
        "warnings": _warnings(bootstrap, unit, frames, orphans),
    }


def _in_parts(
    fan: Fan,
    inputs: list[Path],
    config: Config,
    wanted: np.ndarray,
    predictor: Network,
    extensions: Sequence[Any],
    measured: Any,
    rendered: Any,
) -> tuple[list[Row], float, Scores]:
    files: dict[str, Any] = {
        "pairs": inputs[0],
        "checkpoint": inputs[1],
        "extend": inputs[2] if len(inputs) > 2 else None,
    }
    files |= {"config": config}
    [fitted] = fan("fit", write_fit, [files | {"wanted": wanted}], ".json")
    rows, scale = read_fit(fitted, predictor, extensions, config.only)
    step = PART_BATCHES * config.batch  # whole batches: the network sees the same ones whatever the parts
    todo = [
        files | {"fitted": fitted, "wanted": wanted[k : k + step], "renderings": rendered is not None}
        for k in range(0, len(wanted), step)
    ]
    return rows, scale, join_scores(fan("scores", write_scores, todo, ".h5"), rows, measured, rendered)


def _warnings(bootstrap: TileBootstrap, unit: str, frames: np.ndarray, orphans: np.ndarray) -> list[str]:
    found = []
    if not bootstrap.enough:
        found.append("one site on one ground tile: there is nothing to resample, so no interval is given")
    elif unit == "site":
        found.append("one ground tile: the intervals resample the sites within it and are too narrow")
    elif bootstrap.tiles < MANY_TILES:
        found.append(f"only {bootstrap.tiles} ground tiles: the intervals are too narrow")
    if len(orphans):
        count = len(np.unique(frames[orphans]))
        found.append(f"{count} image(s) without train pairs: gain and offset fitted on the evaluated pixels themselves")
    return found


def _evaluate(
    reader: PairReader,
    predictor: Network,
    extensions: Sequence[Any],
    wanted: np.ndarray,
    config: Config,
    notes: list[str],
    inputs: list[Path],
    output: Path,
    reports: list[Path],
    figures: Path | None,
    overwrite: bool,
    progress: Callable[[int, int, str], None] | None,
    fan: Fan | None,
) -> dict[str, Any]:
    height, width = reader.size
    rows_known = [name for name, _, _ in layout(bool(extensions))]
    for name in config.only:
        if name not in rows_known:
            raise RegistryError.unknown("row of the evaluation", name, rows_known)
    names = len(set(config.only)) or len(rows_known)
    size = names * len(wanted) * height * width * 4
    renderings = size <= RENDERINGS_LIMIT if config.renderings is None else config.renderings
    sizes = {"model": names, "pair": len(wanted), "y": height, "x": width}
    settings = asdict(config) | {"renderings": renderings}
    with ArtefactWriter(
        output, EVALUATION, sizes, config=settings, inputs=inputs, seed=config.seed, overwrite=overwrite
    ) as artefact:
        measured = artefact.dataset("measured")
        rendered = artefact.dataset("rendered") if renderings else None

        def keep(position: int, crops: np.ndarray, images: list[np.ndarray]) -> None:
            measured[position : position + len(crops)] = crops
            if rendered is not None:
                for k, image in enumerate(images):
                    rendered[k, position : position + len(crops)] = image

        if fan is None:
            result, rows, scores, scale = evaluate_pairs(
                reader, predictor, wanted, reader.image_ids, reader.units, config,
                extensions=extensions, keep=keep, progress=progress,
            )  # fmt: skip
        else:
            rows, scale, scores = _in_parts(fan, inputs, config, wanted, predictor, extensions, measured, rendered)
            result = conclude(
                reader, predictor, wanted, reader.image_ids, reader.units, config, rows, scores, scale
            )  # fmt: skip
        result |= {"pairs_file": inputs[0].name, "checkpoint": inputs[1].name, "config": settings}
        result["warnings"] = notes + result["warnings"]
        artefact.write("model_name", scores.names)
        artefact.write("pair_index", wanted)
        artefact.write("tile", np.asarray(reader.tile)[wanted])
        artefact.write("valid_pixels", scores.pixels)
        artefact.write("mse", scores.mse)
        artefact.write("ssim", scores.ssim)
        artefact.file.attrs["split"] = config.split
        artefact.file.attrs["metrics"] = json.dumps(result)
        with companions_of(output):
            for report in reports:
                with atomic_path(report) as partial:
                    partial.write_text(json.dumps(result, indent=1) + "\n")
    if figures is not None:
        from stages.evaluate.figures import write_figures

        write_figures(figures, reader, rows, wanted, scores, scale, result, inputs[1])
    return result
