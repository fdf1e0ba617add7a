"""`lunargr refine`: svbrdf.h5 with albedo and the photographs of scene.h5 -> the same with refined elevations and albedo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from schemas.errors import ConfigError
from stages import refine
from stages.refine import Config

NAME, ORDER = "refine", 62


def command(
    svbrdf: Annotated[Path, typer.Argument(metavar="SVBRDF", help="Reflectance map from 'lunargr albedo'.")],
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="scene.h5 that the albedo was made from.")],
    draws: Annotated[
        int, typer.Option("--draws", min=2, max=1000, help="Draws that the standard deviations are taken from.")
    ] = Config.draws,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="JSON", help="Spectra and noise to use, from '-o NAME.json'."),
    ] = None,
    geotiff: options.GeoTiff = None,
    no_geotiff: options.NoGeoTiff = False,
    shard: options.Shard = None,
    output: options.OutputFile = Path("refined.h5"),
    scheduler: options.Scheduler = None,
    resume: options.ResumeParts = False,
    parts: options.Parts = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Correct the DEM and the albedo of a map together, from the photographs that made the albedo.

    The elevation is corrected only if images left out gain by it; else it stays and the last line says why. Rendering and
    evaluation use the new elevation.

    An output NAME.json gets the spectra, the noise and the gain alone. Shards read them with --calibration.
    """
    config = options.configure(Config, locals(), geotiff=not no_geotiff, shard=options.parse_shard(shard))
    console, to = Console(quiet), options.make_map_output(locals())
    if output.suffix == ".json":
        if to.in_parts or shard or calibration:
            raise ConfigError(
                f"{output}: expected an output NAME.h5 with --shard, --scheduler, --resume and --calibration, found a calibration."
            )
        learned = refine.calibrate_to(svbrdf, scene, to, config, console.progress)
        console.say(f"{output}: spectra and noise of {len(learned.noise.relative)} images")
        return
    summary = refine.run(svbrdf, scene, calibration, to, config, console.say, console.progress)
    rows = [(f"{px:.1f}", f"{m:.3f}", f"{a:.4f}", f"{trust:.2f}") for px, m, a, trust in summary.waves]
    console.table(
        "what map and DEM lack, by wavelength", ("px", "elevation, m a wave", "log albedo", "weight of images"), rows
    )
    if summary.reason:
        console.say(f"{output}: elevation unchanged; {summary.reason}")
        return
    value, low, high = summary.gain
    console.say(
        f"{output}: elevation corrected by {summary.correction:.3f} m rms from {len(summary.images)} images, median standard "
        f"deviation {summary.correction_std:.3f} m; images left out: squared error {-value:+.1f} % ({-high:+.1f} to {-low:+.1f})"
    )
