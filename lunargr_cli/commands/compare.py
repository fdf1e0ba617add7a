"""`lunargr compare PAIRS`: train several reflectance models from several seeds and say which differences are real."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from schemas.later import without
from stages.pipelines import compare_models
from stages.train import Config

NAME, ORDER = "compare", 72


def command(
    pairs: Annotated[Path, typer.Argument(help="Pairs from 'lunargr project'.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for checkpoints, evaluations and the table."),
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
    training = options.configure(Config, locals(), widths=options.read_numbers("--widths", widths, int))
    names = _models(models)
    console = Console(quiet)
    config = compare_models.Config(names, seeds, split, training)
    result = compare_models.run(pairs, options.make_output(locals()), config, console.say, console.progress)
    from stages.compare import difference_lines, result_lines

    console.table(
        f"{len(names)} models x {seeds} seeds on {result['crops']} {split} crops, {result['tiles']} ground tiles",
        *result_lines(result),
    )
    console.table("which differences are larger than their noise", *difference_lines(result))
    console.say(f"written: {output / compare_models.TABLE}, {output / compare_models.CURVES}")


def _models(text: str) -> tuple[str, ...]:
    """Names of models from 'M1,M2'. Raises ConfigError, RegistryError."""
    with without("torch"):
        from stages.physics.photometry import get_model

        return options.check_once("--models", (get_model(name).name for name in options.read_names("--models", text)))
