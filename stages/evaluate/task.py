"""What is compared on what, and the whole comparison in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas import ArtefactError
from stages.common.intervals import FEWEST_UNITS, choose_units
from stages.common.progress import Progress, show_nothing
from stages.effects import load_extension
from stages.evaluate.config import Config
from stages.evaluate.coverage import shares
from stages.evaluate.fitting import Fitting, choose_fit_pairs, dn_scale, fit_rows
from stages.evaluate.perceptual import Perceptual
from stages.evaluate.rows import TITLES, Row, make_renderers, make_rows
from stages.evaluate.scores import Scores, score
from stages.evaluate.table import conclude, gain_table, metric_table, strongest_baselines
from stages.network.predictor import Predictor, choose_device, load_predictor
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Extension
from stages.physics.photometry.published import ParameterSet, hapke_set


@dataclass
class Task:
    """What is compared on what.

    predictors : training runs of one model; wanted : indices of the scored pairs (N,)
    """

    reader: PairReader
    predictors: Sequence[Predictor]
    wanted: np.ndarray
    config: Config
    extensions: Sequence[Extension] = ()

    @property
    def calibrated(self) -> bool:
        """Whether the images are in I/F."""
        return self.reader.units == "iof"

    @property
    def published(self) -> ParameterSet:
        """Hapke's parameters that are scored."""
        return hapke_set(self.reader.wavelength_nm, self.config.published)

    def rows(self) -> list[Row]:
        """The rows of the table that are scored, with their renderers."""
        renderers = make_renderers(self.predictors, self.extensions, self.published)
        return make_rows(renderers, len(self.predictors), bool(self.extensions), self.config.only)

    def fit_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Train pairs to fit on; pairs of uncalibrated images that no train pair shows. Indices (n,) each."""
        train, orphans = choose_fit_pairs(self.reader, self.wanted, self.config.fit_pairs, self.config.seed)
        return train, np.empty(0, int) if self.calibrated else orphans

    def fitting(self) -> Fitting:
        """What the baselines are fitted on."""
        train, orphans = self.fit_pairs()
        size, used = self.config.batch, np.concatenate([train, orphans, self.wanted])
        scale = 1.0 if self.calibrated else dn_scale(self.reader, used, size)
        frames = len(self.reader.image_ids)
        return Fitting(self.reader, train, orphans, frames, self.calibrated, scale, size, self.config.seed)


def make_task(reader: PairReader, checkpoints: Sequence[Path], wanted: np.ndarray, config: Config) -> Task:
    """The comparison of training runs of one model on the pairs ``wanted`` (N,). Raises LunargrError."""
    predictors = [load_predictor(path, choose_device(config.device)) for path in checkpoints]
    extensions = load_extension(Path(config.extend), reader.image_ids) if config.extend else []
    return Task(reader, predictors, wanted, config, extensions)


def score_here(
    task: Task,
    keep: Callable[[int, np.ndarray, list[np.ndarray]], Any] | None = None,
    progress: Progress = show_nothing,
) -> tuple[list[Row], Scores, float]:
    """Fit and score in this process: the rows, the scores of every training run, the full range of DN. keep : see ``score``"""
    done, total = 0, 0

    def tick(count: int) -> None:
        nonlocal done
        done += count
        progress(done, total, "evaluate")

    fitting = task.fitting()
    total = fitting.steps + len(task.wanted)
    progress(0, total, "evaluate")
    rows = task.rows()
    fit_rows(fitting, rows, tick)
    return rows, score(task.reader, rows, task.wanted, fitting.scale, fitting.size, keep, tick), fitting.scale


def summarise(task: Task, scores: Scores, scale: float) -> dict[str, Any]:
    """What the JSON holds. scale : full range of DN"""
    train, orphans = task.fit_pairs()
    perceptual = Perceptual()
    if not scores.pixels.any():
        raise ArtefactError(f"split '{task.config.split}': expected valid pixels, found none; project the pairs again.")
    tile, site = task.reader.tile[task.wanted], task.reader.site[task.wanted]
    unit, name = choose_units(tile, site)
    frames = task.reader.frame
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
        "image_units": task.reader.units,
        "dn_full_range": None if task.calibrated else scale,
        "model": task.predictors[0].model.name,
        "hapke_set": task.published.name,
        "fitted_on_pairs": len(train),
        "frames_fitted_on_split": sorted({task.reader.image_ids[f] for f in frames[orphans]}),
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
