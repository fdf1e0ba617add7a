"""`lunargr train`: pairs.h5 -> checkpoint.h5."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.options import MOST, Device, OutputFile, Overwrite, Quiet, Resume, Seed

NAME, ORDER = "train", 50


def command(
    pairs: Annotated[Path, typer.Argument(help="pairs.h5 from 'lunargr project'.")],
    model: Annotated[
        str, typer.Option("--model", help="Reflectance model to predict; 'lunargr models' lists them.")
    ] = "hapke",
    maps: Annotated[
        str | None,
        typer.Option(
            "--maps",
            metavar="NAME,...",
            help="Coefficients to predict place by place; the others are fitted globally. Default: the model's own choice.",
        ),
    ] = None,
    positive: Annotated[
        bool, typer.Option("--positive", help="Keep coefficients nearly positive (LeakyReLU), as Lunar-G2R does.")
    ] = False,
    epochs: Annotated[int, typer.Option("--epochs", min=1, max=100_000, help="Passes over the training pairs.")] = 20,
    batch: Annotated[int, typer.Option("--batch", min=1, max=MOST, help="Pairs per step, over all processes.")] = 32,
    lr: Annotated[float, typer.Option("--lr", help="Adam's learning rate.")] = 3e-3,
    schedule: Annotated[
        str, typer.Option("--schedule", help="Learning rate over the steps: constant or cosine.")
    ] = "cosine",
    widths: Annotated[
        str, typer.Option("--widths", help="Channels of each stage of the U-Net; Lunar-G2R: 16-32-64-128-256.")
    ] = "8-16-32",
    dropout: Annotated[
        str, typer.Option("--dropout", help="Dropout of each stage, or one for all; Lunar-G2R: 0.1-0.1-0.2-0.2-0.3.")
    ] = "0",
    brightness: Annotated[
        float,
        typer.Option(
            "--brightness", help="Weight of each crop's overall brightness in the loss, 0 to 1; 1: squared errors."
        ),
    ] = 0.1,
    augment: Annotated[
        bool, typer.Option("--augment/--no-augment", help="Turn and mirror crops, Sun and camera along.")
    ] = True,
    precision: Annotated[
        str, typer.Option("--precision", help="fp32, bf16, or auto: bf16 where the processor is made for it.")
    ] = "auto",
    extend: Annotated[
        Path | None, typer.Option("--extend", metavar="FILE", help="diagnosis.h5: train through the extended model.")
    ] = None,
    seed: Seed = 0,
    device: Device = "auto",
    output: OutputFile = Path("checkpoint.h5"),
    overwrite: Overwrite = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Learn reflectance from terrain through the differentiable renderer. Several processes: run under torchrun."""
    from lunargr_cli.console import Console
    from lunargr_cli.options import read_names, read_numbers
    from schemas.files.outputs import Output
    from stages import train

    console = Console(quiet)
    config = train.Config(
        model=model,
        maps=read_names(maps),
        positive=positive,
        epochs=epochs,
        batch=batch,
        lr=lr,
        schedule=schedule,
        widths=read_numbers("--widths", widths, int),
        dropout=read_numbers("--dropout", dropout, float),
        brightness=brightness,
        augment=augment,
        seed=seed,
        device=device,
        precision=precision,
        extend=str(extend) if extend else None,
    )
    found = train.run(pairs, Output(output, overwrite, resume), config, console.say, console.progress)
    best = found.history.best_epoch
    console.say(
        f"{output}: best epoch {best + 1}, validation MSE {found.history.validation_loss[best]:.4e}; "
        f"{found.pairs_per_second:.1f} pairs/s in {found.precision}"
    )
