"""`lunargr merge`: the parts of a sharded stage -> one artefact."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console
from lunargr_cli.options import Overwrite, Quiet
from schemas.files.outputs import Output
from stages import merge
from stages.merge import Config

NAME, ORDER = "merge", 89


def command(
    parts: Annotated[
        list[Path], typer.Argument(metavar="PART...", help="Every part that --shard I/N wrote, in any order.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.")],
    virtual: Annotated[
        bool,
        typer.Option(
            "--virtual", help="Write links to the parts instead of copies, and no GeoTIFF; the parts must stay."
        ),
    ] = Config.virtual,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Join the parts of a sharded command into one file, identical to that of a single run."""
    console = Console(quiet)
    schema = merge.run(parts, Output(output, overwrite), Config(virtual), console.progress)
    console.say(f"{output}: {len(parts)} parts of '{schema.name}' merged")
