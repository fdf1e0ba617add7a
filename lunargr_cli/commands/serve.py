"""`lunargr serve`: views of a map for other programs, over a socket."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from lunargr_cli.commands.render import find_source
from lunargr_cli.console import flush_out, write_out
from lunargr_cli.options import BodyOption, configure, read_parameters
from lunargr_cli.view_options import Dem, Detail, Model, Parameters, RockAbundance, Samples, Sensor, Shadows, Source
from stages.render import Config

NAME, ORDER = "serve", 62


def command(
    source: Source = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 takes one that is free.")] = 5555,
    address: Annotated[
        str, typer.Option(metavar="IP", help="Address to listen at. Whoever reaches it can ask for views.")
    ] = "127.0.0.1",
    dem: Dem = None,
    model: Model = None,
    parameters: Parameters = None,
    sensor: Sensor = None,
    detail: Detail = None,
    rock_abundance: RockAbundance = Config.rock_abundance,
    samples: Samples = None,
    shadows: Shadows = Config.shadows,
    body: BodyOption = None,
) -> None:
    """Answer poses and Suns with images over ZeroMQ, until interrupted; docs/serve.md is the protocol.

    \b
    lunargr serve svbrdf.h5 --port 5555
    """
    given = dict(locals())
    path = find_source(given)
    config = configure(
        Config, given, view="pinhole", parameters=read_parameters(parameters), terrain_only=dem is not None
    )
    from stages.render.renderer import Renderer
    from stages.render.server import serve

    def ready(where: str) -> None:
        write_out(f"{path} at {where}")
        flush_out()  # whoever waits for the line may read it through a pipe

    with Renderer(path, **asdict(config)) as renderer:
        serve(renderer, address, port, ready)
