"""`lunargr albedo`: svbrdf.h5 and the photographs of scene.h5 -> svbrdf.h5 with albedo, and a GeoTIFF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from schemas.errors import ConfigError
from stages import albedo
from stages.albedo import Config

NAME, ORDER = "albedo", 61


def command(
    svbrdf: Annotated[Path, typer.Argument(metavar="SVBRDF", help="Reflectance map from 'lunargr infer'.")],
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="scene.h5 that the map was inferred from.")],
    leave_out: Annotated[
        str | None,
        typer.Option("--leave-out", metavar="ID,...", help="Images to leave out, for evaluation on them."),
    ] = None,
    fold: Annotated[
        str | None,
        typer.Option("--fold", metavar="K/N", help="Leave out every N-th image, starting with the K-th."),
    ] = None,
    register: options.Register = Config.register,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="JSON", help="Calibration of the images to use, from '-o NAME.json'."),
    ] = None,
    geotiff: options.GeoTiff = None,
    no_geotiff: options.NoGeoTiff = False,
    shard: options.Shard = None,
    output: options.OutputFile = Path("svbrdf_albedo.h5"),
    scheduler: options.Scheduler = None,
    resume: options.ResumeParts = False,
    parts: options.Parts = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Add per-pixel albedo to a reflectance map, from all photographs of the scene.

    The albedo multiplies the I/F of the map. It differs from 1 where the photographs agree on a difference, and is 1
    elsewhere. Rendering, evaluation and the GeoTIFF use it.

    An output NAME.json gets the gains, offsets and errors of the images alone. Shards read them with --calibration.
    """
    converted = {
        "leave_out": options.read_names("--leave-out", leave_out),
        "fold": _fold(fold),
        "geotiff": not no_geotiff,
    }
    config = options.configure(Config, locals(), **converted, shard=options.parse_shard(shard))
    console, to = Console(quiet), options.make_map_output(locals())
    if output.suffix == ".json":
        if to.in_parts or shard or calibration:
            raise ConfigError(
                f"{output}: expected an output NAME.h5 with --shard, --scheduler, --resume and --calibration, found a calibration."
            )
        fitted = albedo.calibrate_to(svbrdf, scene, to, config, console.progress)
        console.say(f"{output}: calibration of {len(fitted.gain)} images")
        return
    summary = albedo.run(svbrdf, scene, calibration, to, config, console.say, console.progress)
    mean, std, low, high = summary.albedo
    console.say(
        f"{output}: albedo from {len(summary.images)} images over {summary.covered_share:.1%} of the map, "
        f"{summary.mean_images:.1f} a pixel, {mean:.3f} +- {std:.3f} ({low:.3f} .. {high:.3f}), "
        f"median standard deviation {summary.albedo_std:.3f}"
    )
    if summary.left_out:
        console.say(f"left out: {', '.join(summary.left_out)}")
    rows = []
    for number, (size, shared, own) in enumerate(summary.bands):
        last = number == len(summary.bands) - 1
        rows.append((f"{'over ' if last else ''}{size:.0f}", f"{shared:.4f}", f"{own:.4f}"))
    console.table(
        "log albedo beyond the map, by size of structure", ("px", "shared by all images", "of one image alone"), rows
    )


def _fold(text: str | None) -> tuple[int, int] | None:
    """'2/4' -> (1, 4). Raises ConfigError."""
    if text is None:
        return None
    first, _, last = text.partition("/")
    if first.isdigit() and last.isdigit() and 1 <= int(first) <= int(last) and int(last) > 1:
        return int(first) - 1, int(last)
    raise ConfigError(f"--fold: expected K/N with 1 <= K <= N and N of at least 2, found '{text}'.")
