"""`lunargr train`: pairs.h5 -> checkpoint.h5."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.options import MOST, Device, Output, Overwrite, Quiet, Resume, Seed

NAME, ORDER = "train", 50


def command(
    pairs: Annotated[Path, typer.Argument(help="pairs.h5 from 'lunargr project'.")],
    model: Annotated[
        str, typer.Option("--model", help="Reflectance model to predict; 'lunargr models' lists them.")
    ] = "M2",
    epochs: Annotated[int, typer.Option("--epochs", min=1, max=100_000, help="Passes over the training pairs.")] = 20,
    batch: Annotated[int, typer.Option("--batch", min=1, max=MOST, help="Pairs per step, over all processes.")] = 64,
    lr: Annotated[float, typer.Option("--lr", help="Adam's learning rate.")] = 1e-4,
    schedule: Annotated[
        str, typer.Option("--schedule", help="Learning rate over the epochs: constant or cosine.")
    ] = "constant",
    widths: Annotated[str, typer.Option("--widths", help="Channels of each stage of the U-Net.")] = "16-32-64-128-256",
    augment: Annotated[
        bool, typer.Option("--augment/--no-augment", help="Turn and mirror crops, Sun and camera along.")
    ] = True,
    precision: Annotated[
        str, typer.Option("--precision", help="fp32, bf16, or auto: bf16 where a probe finds it faster.")
    ] = "auto",
    extend: Annotated[
        Path | None, typer.Option("--extend", metavar="FILE", help="diagnosis.h5: train through the extended model.")
    ] = None,
    seed: Seed = 0,
    device: Device = "auto",
    output: Output = Path("checkpoint.h5"),
    overwrite: Overwrite = False,
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Learn reflectance from terrain through the differentiable renderer. Several processes: run under torchrun."""
    from lunargr_cli.console import Console
    from schemas import ConfigError
    from stages import train

    try:
        channels = tuple(int(w) for w in widths.split("-"))
    except ValueError:
        raise ConfigError(f"--widths: expected numbers like 16-32-64-128-256, found '{widths}'.") from None
    console = Console(quiet)
    config = train.Config(
        model=model,
        epochs=epochs,
        batch=batch,
        lr=lr,
        schedule=schedule,
        widths=channels,
        augment=augment,
        seed=seed,
        device=device,
        precision=precision,
        extend=str(extend) if extend else None,
    )
    found = train.run(pairs, output, config, overwrite, resume, console.say, console.progress)
    best = found.history.best_epoch
    console.say(
        f"{output}: best epoch {best + 1}, validation MSE {found.history.validation_loss[best]:.4e}; "
        f"{found.pairs_per_second:.1f} pairs/s in {found.precision}"
    )
