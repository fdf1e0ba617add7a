"""`lunargr export`: checkpoint.h5 -> model.onnx and a model card."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console
from lunargr_cli.options import OutputFile, Overwrite, Quiet
from schemas.files.outputs import Output
from stages import export
from stages.export import Config

NAME, ORDER = "export", 62


def command(
    checkpoint: Annotated[Path, typer.Argument(help="checkpoint.h5 from 'lunargr train'.")],
    output: OutputFile = Path("model.onnx"),
    opset: Annotated[int, typer.Option("--opset", help="ONNX operator set.")] = Config.opset,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Write a trained network as ONNX for maps of any size, with a model card (.md) beside it."""
    made = export.run(checkpoint, Output(output, overwrite), Config(opset))
    Console(quiet).say(
        f"{output}: {made.model}, coefficients {', '.join(made.coefficients)}, sizes in multiples of {made.stride} px, "
        f"{made.size / 1e6:.1f} MB; {made.card} says what it is"
    )
