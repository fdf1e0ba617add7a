"""`lunargr compare PAIRS`: train several reflectance models from several seeds and say which differences are real."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from lunargr_cli.paths import Writes
from schemas import CHECKPOINT, EVALUATION, SPLITS, Schema
from schemas.errors import ConfigError
from schemas.files.outputs import Output, Target, check_outputs
from stages import evaluate, train
from stages.train import Config

NAME, ORDER = "compare", 72


def command(
    pairs: Annotated[Path, typer.Argument(help="Pairs from 'lunargr project'.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for checkpoints, evaluations and the table."),
        Writes.FOLDER,
    ],
    models: Annotated[
        str, typer.Option("--models", help="Reflectance models, separated by commas.")
    ] = "M1,M2,M3,M4,M5,M6,kernels,hapke",
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, max=1000, help="Training runs of every model, from seeds 0, 1, ...")
    ] = 3,
    epochs: options.Epochs = Config.epochs,
    batch: options.Batch = Config.batch,
    lr: options.LearningRate = Config.lr,
    schedule: options.Schedule = Config.schedule,
    widths: options.Widths = options.join_numbers(Config.widths),
    precision: options.TrainingPrecision = Config.precision,
    split: Annotated[
        str, typer.Option("--split", help="Split to compare models on: validation (as in the paper) or test.")
    ] = "validation",
    device: options.Device = Config.device,
    json_file: options.Json = None,
    resume: options.Resume = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Train several models from several seeds on the same pairs, and test which differences exceed the noise.

    With --resume, finished runs in the folder are kept and an interrupted one continues.
    """
    common = options.configure(Config, locals(), widths=options.read_numbers("--widths", widths, int))
    from stages import compare

    console = Console(quiet)
    names = _models(models)
    train.check(common)
    if split not in dict(SPLITS):
        raise ConfigError(f"--split: expected one of {', '.join(dict(SPLITS))}, found '{split}'.")
    runs = [_Runs(output, name, seeds, split) for name in names]
    table, curves = output / compare.TABLE, output / compare.CURVES
    made = [path for run in runs for path in run.files]
    check_outputs([Target(path) for path in (table, curves, *made)], [pairs], overwrite or resume)
    for number, run in enumerate(runs):
        for seed, checkpoint in enumerate(run.checkpoints):
            config = replace(common, model=run.model, seed=seed)
            if not (resume and checkpoint.exists() and _was_trained_with(checkpoint, config, pairs)):
                console.say(f"training {run.model}, seed {seed} ({number * seeds + seed + 1} of {seeds * len(names)})")
                to = Output(checkpoint, overwrite or resume, resume)
                train.run(pairs, to, config, console.say, console.progress)
        if not (resume and run.evaluation.exists() and _was_scored_on(run.evaluation, [pairs, *run.checkpoints])):
            _evaluate(pairs, run, device, console)
    result = compare.run([(run.evaluation, run.checkpoints) for run in runs], Output(output, json=json_file))
    console.table(
        f"{len(names)} models x {seeds} seeds on {result['crops']} {split} crops, {result['tiles']} ground tiles",
        *compare.result_lines(result),
    )
    console.table("which differences are larger than their noise", *compare.difference_lines(result))
    console.say(f"written: {table}, {curves}")


@dataclass(frozen=True)
class _Runs:
    """The files of one model's training runs. folder : of the comparison"""

    folder: Path
    model: str
    seeds: int
    split: str

    @property
    def checkpoints(self) -> list[Path]:
        return [self.folder / f"{self.model}_seed{seed}.checkpoint.h5" for seed in range(self.seeds)]

    @property
    def evaluation(self) -> Path:
        return self.folder / f"{self.model}.{self.split}.h5"

    @property
    def files(self) -> list[Path]:
        """All that is written, with what an unfinished training leaves."""
        unfinished = [path.with_suffix(".resume.h5") for path in self.checkpoints]
        return [*self.checkpoints, *unfinished, self.evaluation, self.evaluation.with_suffix(".json")]


def _models(text: str) -> list[str]:
    """Names of at least two models from 'M1,M2'. Raises ConfigError, RegistryError."""
    from stages.physics.photometry import get_model

    names = list(options.check_once("--models", (get_model(n).name for n in options.read_names("--models", text))))
    if len(names) < 2:
        raise ConfigError(f"--models: expected at least two models, found '{text}'.")
    return names


def _evaluate(pairs: Path, run: _Runs, device: str, console: Console) -> None:
    config = evaluate.Config(split=run.split, renderings=False, device=device, only=("learned",))
    evaluate.run(pairs, run.checkpoints, Output(run.evaluation, overwrite=True), config, console.say, console.progress)


def _was_trained_with(checkpoint: Path, config: Config, pairs: Path) -> bool:
    """Whether a finished checkpoint came from these options and these pairs."""
    from schemas.provenance import sha256

    found, inputs = _read_origin(checkpoint, CHECKPOINT)
    wanted = json.loads(json.dumps(asdict(config)))
    return all(found.get(k) == wanted[k] for k in wanted if k != "device") and inputs[0] == sha256(pairs)


def _was_scored_on(evaluation: Path, inputs: list[Path]) -> bool:
    """Whether a finished evaluation is one of these very files."""
    from schemas.provenance import sha256

    return _read_origin(evaluation, EVALUATION)[1] == [sha256(path) for path in inputs]


def _read_origin(path: Path, schema: Schema) -> tuple[dict[str, Any], list[str]]:
    """The options that an artefact was made with, and the SHA-256 of its inputs."""
    from schemas import open_artefact, read_config
    from schemas.provenance import record_of

    with open_artefact(path, schema) as file:
        return read_config(file), [entry["sha256"] for entry in record_of(file)["inputs"]]
