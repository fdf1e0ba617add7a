"""From files to files: pairs and checkpoint in, table, JSON, evaluation artefact and figures out."""

from __future__ import annotations

import json
import os
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
    open_artefact,
    read_config,
    write_json,
)
from schemas.files.companions import companions_of
from schemas.files.outputs import Target, check_outputs
from stages.common.intervals import FEWEST_UNITS, choose_units
from stages.effects import load_extension
from stages.effects.extension import check_ground
from stages.evaluate.core import Scores, score
from stages.evaluate.coverage import shares
from stages.evaluate.fitting import choose_fit_pairs, dn_scale, fit_rows, fit_steps
from stages.evaluate.parts import first_runs, join_scores, load_predictors, read_fit, write_fit, write_scores
from stages.evaluate.perceptual import Perceptual
from stages.evaluate.renderers import Predictor, Reader
from stages.evaluate.rows import TITLES, Row, layout, make_renderers, make_rows
from stages.evaluate.table import conclude, gain_table, metric_table, strongest_baselines
from stages.network.predictor import Predictor as Network
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Extension

RENDERINGS_LIMIT = 512 * 2**20  # bytes of rendered crops that are kept without being asked for


Progress = Callable[[int, int, str], None]
# (what, function, its arguments for every part, suffix) -> the parts that function(path, **arguments) wrote, in order
Fan = Callable[[str, Callable[..., Any], Sequence[Mapping[str, Any]], str], list[Path]]
PART_BATCHES = 32
FIGURES = ("training_curves.png", "errors.png", "crop_best.png", "crop_median.png", "crop_worst.png")


@dataclass
class Config:
    """Options of evaluate; ``fit_pairs`` bounds the pairs that baselines are fitted on (0: all); ``only``: these rows."""

    split: str = "test"
    batch: int = 16
    fit_pairs: int = 4096
    renderings: bool | None = None
    seed: int = 0
    device: str = "auto"
    only: tuple[str, ...] = ()


@dataclass
class Task:
    """What is compared on what: several predictors are training runs of one model; ``wanted`` are indices of pairs."""

    reader: Reader
    predictors: Sequence[Predictor]
    wanted: np.ndarray
    frame_names: Sequence[str]
    units: str
    config: Config
    extensions: Sequence[Extension] = ()

    @property
    def calibrated(self) -> bool:
        return self.units == "iof"

    def rows(self) -> list[Row]:
        renderers = make_renderers(self.predictors, self.extensions)
        return make_rows(renderers, len(self.predictors), bool(self.extensions), self.config.only)

    def fit_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Train pairs to fit on; pairs of uncalibrated images that no train pair shows."""
        train, orphans = choose_fit_pairs(self.reader, self.wanted, self.config.fit_pairs, self.config.seed)
        return train, np.empty(0, int) if self.calibrated else orphans


@dataclass
class Files:
    """What is read and written."""

    pairs: Path
    checkpoints: list[Path]
    extend: Path | None
    output: Path
    json_file: Path | None

    @property
    def inputs(self) -> list[Path]:
        return [self.pairs, *self.checkpoints, *([self.extend] if self.extend else [])]

    @property
    def reports(self) -> list[Path]:
        beside = self.output.with_suffix(".json")
        same = self.json_file is None or os.path.realpath(self.json_file) == os.path.realpath(beside)
        return [beside] if same or self.json_file is None else [beside, self.json_file]


def run(
    pairs: Path,
    checkpoint: Path | Sequence[Path],
    output: Path,
    config: Config,
    *,
    extend: Path | None = None,
    json_file: Path | None = None,
    figures: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    fan: Fan | None = None,
) -> dict[str, Any]:
    """Evaluate a checkpoint, or several training runs of one model, on a split of a pairs file; returns what the JSON holds.

    ``fan`` has the crops scored in parts, wherever it works on them.

    Writes ``output`` (evaluation artefact), the JSON beside it (and at ``json_file``), and figures where asked.
    Raises ConfigError or ArtefactError before anything is written.
    """
    checkpoints = [checkpoint] if isinstance(checkpoint, Path) else list(checkpoint)
    files = Files(pairs, checkpoints, extend, output, json_file)
    beside, *others = files.reports
    targets = [Target(output), Target(beside, what=f"the JSON beside {output.name}")]
    targets += [Target(report, "--json") for report in others]
    if figures is not None:
        targets += [Target(figures / name, "--figures") for name in FIGURES]
    check_outputs(targets, files.inputs, overwrite)
    _check(config, bool(extend))
    with PairReader(pairs) as reader:
        wanted = select(reader, config.split)
        predictors = load_predictors(checkpoints, config.device)
        _check_runs(checkpoints, predictors, reader)
        notes = [*_notes(checkpoints[0], predictors[0], reader, extend)]
        if extend:
            notes += check_ground(extend, pairs)
        extensions = load_extension(extend, reader.image_ids) if extend else []
        task = Task(reader, predictors, wanted, reader.image_ids, reader.units, config, extensions)
        rows, scores, scale, result = _write(task, files, notes, overwrite, progress, fan)
        if figures is not None:
            from stages.evaluate.figures import write_figures

            first = [rows[k] for k in first_runs(rows)]
            write_figures(figures, reader, first, wanted, scores.mean_over_runs(), scale, result, checkpoints[0])
    return result


def _check(config: Config, extended: bool) -> None:
    if config.split not in dict(SPLITS):
        raise ConfigError(f"--split: expected one of {', '.join(dict(SPLITS))}, found '{config.split}'.")
    if config.batch < 1 or config.fit_pairs < 0:
        raise ConfigError(
            f"--batch, --fit-pairs: expected at least 1 and 0, found {config.batch} and {config.fit_pairs}."
        )
    known = [name for name, _, _ in layout(extended)]
    for name in config.only:
        if name not in known:
            raise RegistryError.unknown("row of the evaluation", name, known)


def _check_runs(checkpoints: Sequence[Path], predictors: Sequence[Network], reader: PairReader) -> None:
    """Several checkpoints are training runs of one model from different seeds, in the units of the pairs."""
    seeds: dict[int, Path] = {}
    for path, predictor in zip(checkpoints, predictors, strict=True):
        if reader.units == "iof" and predictor.image_units == "dn":
            raise ArtefactError(
                f"{path}: expected a checkpoint trained on I/F images as in {reader.path.name}, found one trained on "
                "DN, whose brightness scale is arbitrary; train on these pairs."
            )
        if predictor.model.name != predictors[0].model.name:
            raise ConfigError(
                f"{path}: expected another training run of {predictors[0].model.name} as in {checkpoints[0].name}, found "
                f"{predictor.model.name}; 'lunargr compare' compares models."
            )
        seed = read_seed(path)
        if seed in seeds:
            raise ConfigError(
                f"{path}: expected a training run from another seed than {seeds[seed].name}, found seed {seed} again; "
                "train it with another --seed."
            )
        seeds[seed] = path


def read_seed(checkpoint: Path) -> int:
    """The seed that a checkpoint was trained from."""
    with open_artefact(checkpoint, CHECKPOINT) as file:
        return int(file.attrs["seed"])


def select(reader: PairReader, split: str) -> np.ndarray:
    """Indices of the split's pairs. Raises ArtefactError where there are none, or none to fit the baselines on."""
    counts = ", ".join(f"{name} {int((reader.split == value).sum())}" for name, value in SPLITS)
    for part, purpose in ((split, "to evaluate"), ("train", "to fit the baselines on")):
        if not len(reader.indices(part)):
            raise ArtefactError(
                f"{reader.path}:/split: expected '{part}' pairs {purpose}, found none ({counts}); sample more crops."
            )
    return reader.indices(split)


def _notes(checkpoint: Path, predictor: Network, reader: PairReader, extend: Path | None) -> list[str]:
    notes = []
    if abs(predictor.gsd / reader.gsd - 1) > 0.01:
        notes.append(f"the checkpoint was trained at {predictor.gsd:g} m per pixel, these pairs have {reader.gsd:g} m")
    with open_artefact(checkpoint, CHECKPOINT) as file:
        trained_with = read_config(file).get("extend")
    if trained_with and extend is None:
        notes.append(f"the checkpoint was trained with the effects of '{Path(trained_with).name}': add --extend")
    if read_config(reader.file).get("register"):
        notes.append(
            "the images were registered on ground of every part of the split, the scored one included (project --register)"
        )
    return notes


def evaluate_pairs(
    task: Task,
    *,
    keep: Callable[[int, np.ndarray, list[np.ndarray]], Any] | None = None,
    progress: Progress | None = None,
) -> tuple[list[Row], Scores, float, dict[str, Any]]:
    """The pure comparison: (rows, scores of every training run, DN scale, what the JSON holds)."""
    train, orphans = task.fit_pairs()
    size, wanted = task.config.batch, task.wanted
    total = fit_steps(train, orphans, task.calibrated) + len(wanted)
    done = 0

    def tick(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, total, "evaluate")

    if progress is not None:
        progress(0, total, "evaluate")
    scale = 1.0 if task.calibrated else dn_scale(task.reader, np.concatenate([train, orphans, wanted]), size)
    rows = task.rows()
    fit_rows(
        task.reader, rows, train, orphans, len(task.frame_names), task.calibrated, scale, size, task.config.seed, tick
    )
    scores = score(task.reader, rows, wanted, scale, size, Perceptual(), keep, tick)
    return rows, scores, scale, summarise(task, scores, scale)


def summarise(task: Task, scores: Scores, scale: float) -> dict[str, Any]:
    """What the JSON holds."""
    train, orphans = task.fit_pairs()
    perceptual = Perceptual()
    if not scores.pixels.any():
        raise ArtefactError(f"split '{task.config.split}': expected valid pixels, found none; project the pairs again.")
    tile, site = (np.asarray(v)[task.wanted] for v in (task.reader.tile, task.reader.site))
    unit, name = choose_units(tile, site)
    frames = np.asarray(task.reader.frame)
    models = metric_table(scores, unit)
    result: dict[str, Any] = {
        "split": task.config.split,
        "models": models,
        "gains": gain_table(scores, unit),
        "strongest_baseline": strongest_baselines(models),
        "titles": {row: TITLES[row] for row in models},
        "pairs": len(task.wanted),
        "valid_pixels": int(scores.pixels.sum()),
        "tiles": len(np.unique(tile)),
        "sites": len(np.unique(site)),
        "training_runs": len(task.predictors),
        "interval_unit": name,
        "intervals": "delete-one-unit jackknife, Student's t, 95 %",
        "image_units": task.units,
        "dn_full_range": None if task.calibrated else scale,
        "model": task.predictors[0].model.name,
        "fitted_on_pairs": len(train),
        "frames_fitted_on_split": sorted({task.frame_names[f] for f in frames[orphans]}),
        "coverage_percent": shares(scores.within.sum(axis=2)) if scores.within.any() else None,
        "lpips_unavailable": None if perceptual.available else perceptual.reason,
        "warnings": _warnings(name, len(np.unique(unit)), len(task.predictors), len(np.unique(frames[orphans]))),
    }
    return result | {"conclusions": conclude(result)}


def _warnings(unit: str, units: int, runs: int, orphans: int) -> list[str]:
    found = []
    if units == 1:
        found.append("one site on one ground tile: there is no spread to judge by, so no interval is given")
    elif unit == "site":
        found.append("one ground tile: the intervals take its sites for independent and are too narrow")
    elif units < FEWEST_UNITS:
        found.append(f"only {units} ground tiles: the intervals are wide, and untested below {FEWEST_UNITS}")
    if runs == 1:
        found.append("one training run: the intervals of learned rows hold the ground's spread only, not that of seeds")
    if orphans:
        found.append(
            f"{orphans} image(s) without train pairs: gain and offset fitted on the evaluated pixels themselves"
        )
    return found


def _in_parts(task: Task, files: Files, fan: Fan, measured: Any, rendered: Any) -> tuple[list[Row], Scores, float]:
    shared: dict[str, Any] = {"pairs": files.pairs, "checkpoints": files.checkpoints, "extend": files.extend}
    shared |= {"config": task.config}
    [fitted] = fan("fit", write_fit, [shared | {"wanted": task.wanted}], ".json")
    rows = task.rows()
    scale = read_fit(fitted, rows)
    step = PART_BATCHES * task.config.batch  # whole batches: the network sees the same ones whatever the parts
    todo = [
        shared | {"fitted": fitted, "wanted": task.wanted[k : k + step], "renderings": rendered is not None}
        for k in range(0, len(task.wanted), step)
    ]
    return rows, join_scores(fan("scores", write_scores, todo, ".h5"), rows, measured, rendered), scale


def _write(
    task: Task, files: Files, notes: list[str], overwrite: bool, progress: Progress | None, fan: Fan | None
) -> tuple[list[Row], Scores, float, dict[str, Any]]:
    config, count = task.config, len(task.wanted)
    height, width = task.reader.size  # type: ignore[attr-defined]
    planned = task.rows()
    first = first_runs(planned)
    size = len(first) * count * height * width * 4
    renderings = size <= RENDERINGS_LIMIT if config.renderings is None else config.renderings
    sizes = {"model": len(first), "run": len(files.checkpoints), "pair": count, "y": height, "x": width}
    settings = asdict(config) | {"renderings": renderings}
    with ArtefactWriter(
        files.output, EVALUATION, sizes, config=settings, inputs=files.inputs, seed=config.seed, overwrite=overwrite
    ) as artefact:
        measured = artefact.dataset("measured")
        rendered = artefact.dataset("rendered") if renderings else None

        def keep(position: int, crops: np.ndarray, images: list[np.ndarray]) -> None:
            measured[position : position + len(crops)] = crops
            if rendered is not None:
                for k, row in enumerate(first):
                    rendered[k, position : position + len(crops)] = images[row]

        if fan is None:
            rows, scores, scale, result = evaluate_pairs(task, keep=keep, progress=progress)
        else:
            rows, scores, scale = _in_parts(task, files, fan, measured, rendered)
            result = summarise(task, scores, scale)
        names = [path.name for path in files.checkpoints]
        seeds = [read_seed(path) for path in files.checkpoints]
        result |= {"pairs_file": files.pairs.name, "checkpoint": names[0], "checkpoints": names, "seeds": seeds}
        result |= {"config": settings, "warnings": notes + result["warnings"]}
        table = scores.mean_over_runs()
        artefact.write("model_name", table.names)
        artefact.write("pair_index", task.wanted)
        artefact.write("tile", np.asarray(task.reader.tile)[task.wanted])
        artefact.write("valid_pixels", table.pixels)
        artefact.write("mse", table.mse)
        artefact.write("ssim", table.ssim)
        artefact.write("run_seed", seeds)
        if "learned" in table.names:
            artefact.write("run_mse", scores.runs("learned", "mse"))
        artefact.file.attrs["split"] = config.split
        artefact.file.attrs["metrics"] = json.dumps(result)
        with companions_of(files.output):
            for report in files.reports:
                write_json(report, result)
    return rows, scores, scale, result
