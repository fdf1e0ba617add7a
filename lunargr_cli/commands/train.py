"""`lunargr train`: pairs.h5 -> checkpoint.h5."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from stages import train
from stages.train import Config

NAME, ORDER = "train", 50


def command(
    pairs: Annotated[Path, typer.Argument(help="pairs.h5 from 'lunargr project'.")],
    model: Annotated[
        str,
        typer.Option(
            "--model",
            autocompletion=options.complete_model,
            help="Reflectance model to predict; 'lunargr models' lists them.",
        ),
    ] = Config.model,
    maps: Annotated[
        str | None,
        typer.Option(
            "--maps",
            metavar="NAME,...",
            help="Coefficients to predict per pixel; the others get one global value (default: set by the model).",
        ),
    ] = None,
    positive: Annotated[
        bool, typer.Option("--positive", help="Keep coefficients nearly positive (LeakyReLU), as Lunar-G2R does.")
    ] = Config.positive,
    epochs: options.Epochs = Config.epochs,
    batch: options.Batch = Config.batch,
    lr: options.LearningRate = Config.lr,
    schedule: options.Schedule = Config.schedule,
    widths: options.Widths = options.join_numbers(Config.widths),
    dropout: Annotated[
        str, typer.Option("--dropout", help="Dropout of each stage, or one for all; Lunar-G2R: 0.1-0.1-0.2-0.2-0.3.")
    ] = options.join_numbers(Config.dropout),
    brightness: Annotated[
        float,
        typer.Option(
            "--brightness", help="Weight of each crop's mean brightness in the loss, 0 to 1 (1: plain squared error)."
        ),
    ] = Config.brightness,
    augment: Annotated[
        bool, typer.Option("--augment/--no-augment", help="Rotate and mirror crops together with Sun and camera.")
    ] = Config.augment,
    precision: options.TrainingPrecision = Config.precision,
    extend: Annotated[
        Path | None,
        typer.Option("--extend", metavar="FILE", help="diagnosis.h5: train with the effects that it names."),
    ] = None,
    seed: options.Seed = Config.seed,
    device: options.Device = Config.device,
    output: options.OutputFile = Path("checkpoint.h5"),
    overwrite: options.Overwrite = False,
    resume: options.Resume = False,
    quiet: options.Quiet = False,
) -> None:
    """Learn reflectance from terrain through the differentiable renderer. Run it under torchrun for several processes."""
    texts = {"maps": options.read_names("--maps", maps), "extend": str(extend) if extend else None}
    numbers = {
        "widths": options.read_numbers("--widths", widths, int),
        "dropout": options.read_numbers("--dropout", dropout, float),
    }
    config = options.configure(Config, locals(), **texts, **numbers)
    console = Console(quiet)
    summary = train.run(pairs, options.make_output(locals()), config, console.say, console.progress)
    best = summary.history.best_epoch
    error = math.sqrt(summary.history.validation_loss[best])
    console.say(
        f"{output}: best epoch {best + 1}, validation RMSE {error:.5f} in {summary.error_unit}; "
        f"{summary.pairs_per_second:.1f} pairs/s in {summary.precision}"
    )
