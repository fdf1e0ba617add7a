"""`lunargr report FILES`: everything a run has produced, on one self-contained page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console
from lunargr_cli.options import OutputFile, Overwrite, Quiet
from schemas.files.outputs import Output
from stages import report
from stages.report import Config

NAME, ORDER = "report", 85


def command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILES",
            help="Artefacts (.h5), JSON results of evaluate, match, compare or diagnose, pictures (.png, .jpg), "
            "and pages of 'lunargr view' (.html) to link to.",
        ),
    ],
    output: OutputFile = Path("report.html"),
    title: Annotated[str, typer.Option("--title", help="Title of the page.")] = Config.title,
    note: Annotated[str, typer.Option("--note", help="A remark above the results.")] = Config.note,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Put maps, tables, curves and pictures of a run on one self-contained HTML page."""
    console = Console(quiet)
    titles = report.run(files, Output(output, overwrite), Config(title, note), console.progress)
    console.say(f"{output}: {', '.join(titles)}")
