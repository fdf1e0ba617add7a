"""`lunargr infer`: scene.h5 or a DEM, and checkpoint.h5 -> svbrdf.h5 and a GeoTIFF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from stages.infer import Config
from stages.pipelines import infer_terrain

NAME, ORDER = "infer", 60


def command(
    terrain: Annotated[Path, typer.Argument(metavar="SCENE|DEM", help="scene.h5, or a DEM that GDAL reads.")],
    checkpoint: Annotated[Path, typer.Argument(help="checkpoint.h5 from 'lunargr train'.")],
    window: Annotated[
        int | None,
        typer.Option(
            "--window",
            min=16,
            max=options.MOST,
            help="Window size, px; context around it is added (default: what is fast).",
        ),
    ] = None,
    precision: Annotated[
        str,
        typer.Option(
            "--precision",
            help="fp32, bf16, or auto: bf16 where the processor supports it and the map stays the same within 2 %.",
        ),
    ] = Config.precision,
    any_gsd: Annotated[
        bool, typer.Option("--any-gsd", help="Allow a DEM whose GSD differs from the training GSD.")
    ] = Config.any_gsd,
    geotiff: options.GeoTiff = None,
    no_geotiff: options.NoGeoTiff = False,
    body: options.BodyOption = None,
    device: options.Device = Config.device,
    shard: options.Shard = None,
    output: options.OutputFile = Path("svbrdf.h5"),
    scheduler: options.Scheduler = None,
    resume: options.ResumeParts = False,
    parts: options.Parts = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Predict georeferenced maps of reflectance coefficients for a DEM of any size."""
    settings = options.configure(Config, locals(), shard=options.parse_shard(shard), geotiff=not no_geotiff)
    console, to = Console(quiet), options.make_map_output(locals())
    summary = infer_terrain.run(
        terrain, checkpoint, to, infer_terrain.Config(settings, body), console.say, console.progress
    )
    console.say(
        f"{output}: {summary.grid.height} x {summary.grid.width} px at {summary.grid.gsd:g} m, {summary.valid_share:.1%} valid"
    )
    rows = [(name, *(f"{v:.5f}" for v in values)) for name, values in summary.coefficients.items()]
    console.table(f"coefficients of {summary.model}", ("name", "mean", "std", "1 %", "99 %"), rows)
