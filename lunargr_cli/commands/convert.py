"""`lunargr convert`: coefficient GeoTIFFs between the conventions of ISIS, ASP, Sato et al. and others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console
from lunargr_cli.options import OutputFile, Overwrite, Quiet, read_names
from schemas.files.outputs import Output
from stages import convert

NAME, ORDER = "convert", 86


def command(
    source: Annotated[Path, typer.Argument(help="GeoTIFF of coefficient maps, one band each.")],
    start: Annotated[
        str, typer.Option("--from", metavar="SYSTEM:MODEL", help="Convention of the input, e.g. sato:Hapke.")
    ],
    end: Annotated[
        str, typer.Option("--to", metavar="SYSTEM:MODEL", help="Convention of the output, e.g. lunargr:hapke.")
    ],
    output: OutputFile,
    bands: Annotated[
        str | None,
        typer.Option(
            "--bands",
            metavar="NAME,...|NAME=INDEX,...",
            help="Names of the input's bands, if the file does not name them.",
        ),
    ] = None,
    approximate: Annotated[
        bool, typer.Option("--approximate", help="Convert even if the target convention loses information.")
    ] = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Write coefficient maps in another program's convention; 'lunargr models --conventions' lists them."""
    console = Console(quiet)
    config = convert.Config(start, end, None if bands is None else read_names("--bands", bands), approximate)
    report = convert.run(source, Output(output, overwrite), config, console.progress)
    for loss in report.losses:
        console.say(f"lost: {loss}")
    console.say(
        f"{output}: {report.target.name}, {report.valid_pixels} valid pixels; its formula gives {report.target.returns}"
    )
    rows = [(k, name, unit) for k, (name, unit) in enumerate(report.target.quantities, start=1)]
    console.table("bands", ("band", "quantity", "unit"), rows)
