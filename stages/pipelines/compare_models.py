"""Train several reflectance models from several seeds on the same pairs, score them, and compare the scores."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from schemas import CHECKPOINT, EVALUATION, SPLITS, Schema
from schemas.errors import ConfigError
from schemas.files.outputs import Output, Target, write_json
from stages import evaluate, train
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.train.config import state_path

TABLE, CURVES = "comparison.json", "validation_curves.png"  # within the folder of a comparison


@dataclass(frozen=True)
class Config:
    """models : by name; seeds : training runs of every model, from 0 on; split : on which they are compared

    training : how each is trained, with its own model and seed
    level : of significance, after Holm's adjustment, below which a difference is called larger than its noise
    """

    models: tuple[str, ...] = ("M1", "M2", "M3", "M4", "M5", "M6", "kernels", "hapke")
    seeds: int = 3
    split: str = "validation"
    training: train.Config = field(default_factory=train.Config)
    level: float = 0.05


@dataclass(frozen=True)
class Runs:
    """The files of one model's training runs. folder : of the comparison"""

    folder: Path
    model: str
    seeds: int
    split: str

    @property
    def checkpoints(self) -> list[Path]:
        """One of each seed."""
        return [self.folder / f"{self.model}_seed{seed}.checkpoint.h5" for seed in range(self.seeds)]

    @property
    def evaluation(self) -> Path:
        """Of all of them."""
        return self.folder / f"{self.model}.{self.split}.h5"

    @property
    def files(self) -> list[Path]:
        """All that is written, with what an unfinished training leaves."""
        unfinished = [state_path(Output(path)) for path in self.checkpoints]
        return [*self.checkpoints, *unfinished, self.evaluation, self.evaluation.with_suffix(".json")]


def _runs(call: runner.Call) -> list[Runs]:
    config = call.config
    return [Runs(call.output.file, name, config.seeds, config.split) for name in config.models]


def _targets(call: runner.Call) -> Iterator[Target]:
    folder = call.output.file
    for path in (folder / TABLE, folder / CURVES, *(p for run in _runs(call) for p in run.files)):
        yield Target(path, state=call.output.resume)


def _check(call: runner.Call) -> None:
    for model in call.config.models:
        replace(call.config.training, model=model).check()
    if len(call.config.models) < 2:
        raise ConfigError(f"`models`: expected at least two models, found '{','.join(call.config.models)}'.")
    if call.config.split not in dict(SPLITS):
        raise ConfigError(f"`split`: expected one of {', '.join(dict(SPLITS))}, found '{call.config.split}'.")


@runner.stage(writes=_targets, check=_check, content=lambda result: result)
def run(
    pairs: Path, output: Output | Path, config: Config, say: Say = say_nothing, progress: Progress = show_nothing
) -> dict[str, Any]:
    """Write checkpoints, evaluations, the table and the curves into the folder ``output``; returns what the table holds.

    An output that is resumed keeps finished runs, and goes on with an unfinished one. Raises LunargrError.
    """
    from stages.compare import compare, read_runs, write_curves
    from stages.train.checks import check

    check(config.training)
    output, replaceable = Output.at(output), Output.at(output).overwrite or Output.at(output).resume
    runs = [Runs(output.file, name, config.seeds, config.split) for name in config.models]
    trainings = [(run, seed, path) for run in runs for seed, path in enumerate(run.checkpoints)]
    for number, (run, seed, checkpoint) in enumerate(trainings, start=1):
        training = replace(config.training, model=run.model, seed=seed)
        if not (output.resume and checkpoint.exists() and _was_trained_with(checkpoint, training, pairs)):
            say(f"training {run.model}, seed {seed} ({number} of {len(trainings)})")
            train.run(pairs, Output(checkpoint, replaceable, output.resume), training, say, progress)
        inputs = [pairs, *run.checkpoints]
        scored = (
            output.resume and run.evaluation.exists() and _read_origin(run.evaluation, EVALUATION)[1] == _sha256(inputs)
        )
        if seed == config.seeds - 1 and not scored:
            scoring = evaluate.Config(
                split=run.split, renderings=False, device=config.training.device, only=("learned",)
            )
            evaluate.run(pairs, run.checkpoints, Output(run.evaluation, overwrite=True), scoring, say, progress)
    trained = [one for run in runs for one in read_runs(run.evaluation, run.checkpoints)]
    result = compare(trained, config.level)
    write_curves(trained, output.file / CURVES)
    write_json(output.file / TABLE, result)
    return result


def _was_trained_with(checkpoint: Path, config: train.Config, pairs: Path) -> bool:
    """Whether a finished checkpoint came from these options and these pairs."""
    found, inputs = _read_origin(checkpoint, CHECKPOINT)
    wanted = json.loads(json.dumps(asdict(config)))
    return all(found.get(k) == wanted[k] for k in wanted if k != "device") and inputs[:1] == _sha256([pairs])


def _sha256(files: list[Path]) -> list[str]:
    from schemas.provenance import sha256

    return [sha256(path) for path in files]


def _read_origin(path: Path, schema: Schema) -> tuple[dict[str, Any], list[str]]:
    """The options that an artefact was made with, and the SHA-256 of its inputs."""
    from schemas import open_artefact, read_config
    from schemas.provenance import record_of

    with open_artefact(path, schema) as file:
        return read_config(file), [entry["sha256"] for entry in record_of(file)["inputs"]]
