"""`lunargr view`: one HTML page that relights a reflectance map in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console
from lunargr_cli.options import OutputFile, Overwrite, Quiet, configure
from schemas.files.outputs import Output
from stages import view
from stages.view import Config

NAME, ORDER = "view", 61


def command(
    source: Annotated[Path, typer.Argument(metavar="SVBRDF.h5", help="Reflectance map from 'lunargr infer'.")],
    output: OutputFile = Path("view.html"),
    pairs: Annotated[
        Path | None, typer.Option("--pairs", metavar="PAIRS.h5", help="Show measured photographs beside the map.")
    ] = None,
    photographs: Annotated[
        int, typer.Option(metavar="N", help="With --pairs: number of crops to show.")
    ] = Config.photographs,
    max_px: Annotated[
        int,
        typer.Option("--max-px", metavar="PX", help="Largest edge; larger maps are averaged over blocks of pixels."),
    ] = Config.max_px,
    sun_azimuth_deg: Annotated[
        float,
        typer.Option(
            "--sun-azimuth", metavar="DEG", help="Azimuth of the Sun in the first picture, clockwise from north."
        ),
    ] = Config.sun_azimuth_deg,
    sun_elevation_deg: Annotated[
        float, typer.Option("--sun-elevation", metavar="DEG", help="Elevation of the Sun in the first picture.")
    ] = Config.sun_elevation_deg,
    title: Annotated[str | None, typer.Option("--title", help="Title of the page (default: the map's name).")] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Make an offline web page that relights a map: move the Sun and the camera, show every layer, read values.

    \b
    lunargr view svbrdf.h5 -o view.html
    lunargr view svbrdf.h5 --pairs pairs.h5 -o view.html
    """
    config = configure(Config, locals())
    console = Console(quiet)
    made = view.run(source, pairs, Output(output, overwrite), config, console.progress)
    smaller = f", means of {made.factor} x {made.factor} px" if made.factor > 1 else ""
    console.say(
        f"{output}: {made.height} x {made.width} px{smaller}, {made.model}, {made.layers} maps, "
        f"{made.photographs} photographs, {made.size / 1e6:.1f} MB"
    )
