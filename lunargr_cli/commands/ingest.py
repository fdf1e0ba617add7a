"""`lunargr ingest`: DEM and image table -> scene.h5."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from stages import ingest
from stages.ingest import Config

NAME, ORDER = "ingest", 20


def command(
    dem: Annotated[
        Path,
        typer.Argument(
            help="DEM that GDAL reads: GeoTIFF, PDS IMG, ISIS cube; metres or degrees. Or a scene.h5 to add images to."
        ),
    ],
    images: Annotated[
        Path | None, typer.Option("--images", help="Image table: images.csv, or JSON with the same keys.")
    ] = None,
    gsd: Annotated[
        float | None, typer.Option("--gsd", help="Working ground sample distance, m (default: the DEM's own).")
    ] = None,
    crop: Annotated[
        int,
        typer.Option("--crop", min=1, max=options.MOST, help="Crop size in pixels, for the split's ground tiles."),
    ] = Config.crop,
    output: options.OutputFile = Path("scene.h5"),
    body: options.BodyOption = Config.body,
    skip_outside: Annotated[
        bool, typer.Option("--skip-outside", help="Leave out images that do not touch the DEM.")
    ] = Config.skip_outside,
    trust_table: Annotated[
        bool,
        typer.Option("--trust-table", help="Accept Suns that are not those of their times, and unlikely orbits."),
    ] = Config.trust_table,
    shard: options.Shard = None,
    scheduler: options.Scheduler = None,
    resume: options.ResumeParts = False,
    parts: options.Parts = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Put a DEM on a metric grid and find the valid ground of each image."""
    config = options.configure(Config, locals(), shard=options.parse_shard(shard))
    console, to = Console(quiet), options.make_output(locals())
    summary = ingest.run(dem, images, to, config, console.say, console.progress)
    grid, (low, high) = summary.grid, summary.elevation_range
    heights = f"{low:.1f} to {high:.1f} m" if summary.dem_valid_share else "no elevations"
    method = "reprojected to a local metric grid" if summary.resampled else "area means of the DEM's own grid"
    console.say(
        f"{output}: {grid.height} x {grid.width} px at {grid.gsd:g} m, {method}; "
        f"{summary.dem_valid_share:.1%} valid, {heights}"
    )
    for name in summary.skipped:
        console.say(f"left out: image '{name}' does not touch the DEM")
    for frame in summary.blank:
        console.say(
            f"warning: {frame.path}: image '{frame.image_id}' has no valid pixel on the DEM; is it all nodata there?"
        )
    if summary.frames:
        rows = [(f.image_id, f.units, f"{a:.2f}") for f, a in zip(summary.frames, summary.valid_area_km2, strict=True)]
        console.table("images: valid ground", ("image", "units", "km2"), rows)
