"""What is refused before anything is scored, and what a reader of the result should know."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from schemas import CHECKPOINT, SPLITS, ArtefactError, ConfigError, RegistryError, open_artefact, read_config
from stages.effects.extension import check_ground
from stages.evaluate.config import Config
from stages.evaluate.rows import layout
from stages.evaluate.task import Task
from stages.pairs.reader import PairReader
from stages.physics.photometry.published import hapke_set


def check(config: Config) -> None:
    """Refuse options that cannot be. Raises ConfigError, RegistryError."""
    if config.split not in dict(SPLITS):
        raise ConfigError(f"`split`: expected one of {', '.join(dict(SPLITS))}, found '{config.split}'.")
    if config.batch < 1 or config.fit_pairs < 0:
        raise ConfigError(
            f"`batch`, `fit_pairs`: expected at least 1 and 0, found {config.batch} and {config.fit_pairs}."
        )
    hapke_set(math.nan, config.published)
    known = [name for name, _, _ in layout(bool(config.extend))]
    for name in config.only:
        if name not in known:
            raise RegistryError.unknown("row of the evaluation", name, known)


def check_runs(checkpoints: Sequence[Path], task: Task) -> None:
    """Several checkpoints are training runs of one model from different seeds, in the units of the pairs.

    Raises ArtefactError, ConfigError.
    """
    seeds: dict[int, Path] = {}
    for path, predictor in zip(checkpoints, task.predictors, strict=True):
        if task.calibrated and predictor.image_units == "dn":
            raise ArtefactError(
                f"{path}: expected a checkpoint trained on I/F images as in {task.reader.path.name}, found one trained on "
                "DN, whose brightness scale is arbitrary; train on these pairs."
            )
        if predictor.model.name != task.predictors[0].model.name:
            raise ConfigError(
                f"{path}: expected another training run of {task.predictors[0].model.name} as in {checkpoints[0].name}, found "
                f"{predictor.model.name}; 'lunargr compare' compares models."
            )
        seed = read_seed(path)
        if seed in seeds:
            raise ConfigError(
                f"{path}: expected a training run from another seed than {seeds[seed].name}, found seed {seed} again; "
                "train it with another `seed`."
            )
        seeds[seed] = path


def read_seed(checkpoint: Path) -> int:
    """The seed that a checkpoint was trained from."""
    with open_artefact(checkpoint, CHECKPOINT) as file:
        return int(file.attrs["seed"])


def select(reader: PairReader, split: str) -> np.ndarray:
    """Indices of the split's pairs, (N,). Raises ArtefactError where there are none, or none to fit the baselines on."""
    counts = ", ".join(f"{name} {int((reader.split == value).sum())}" for name, value in SPLITS)
    for part, purpose in ((split, "to evaluate"), ("train", "to fit the baselines on")):
        if not len(reader.indices(part)):
            raise ArtefactError(
                f"{reader.path}:/split: expected '{part}' pairs {purpose}, found none ({counts}); sample more crops."
            )
    return reader.indices(split)


def limitations(checkpoint: Path, task: Task) -> list[str]:
    """What limits the comparison without forbidding it."""
    predictor, reader, extend = task.predictors[0], task.reader, task.config.extend
    found = []
    if abs(predictor.gsd / reader.gsd - 1) > 0.01:
        found.append(f"the checkpoint was trained at {predictor.gsd:g} m per pixel, these pairs have {reader.gsd:g} m")
    with open_artefact(checkpoint, CHECKPOINT) as file:
        trained_with = read_config(file).get("extend")
    if trained_with and not extend:
        found.append(f"the checkpoint was trained with the effects of '{Path(trained_with).name}': add `extend`")
    if read_config(reader.file).get("register"):
        found.append("the images were registered on ground of every part of the split, the scored one included")
    return found + (check_ground(Path(extend), reader.path) if extend else [])
