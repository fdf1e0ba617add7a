"""`lunargr normalize`: the images of scene.h5 at a standard geometry, and their mosaics, as normalized.h5 and a GeoTIFF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from stages import normalize
from stages.common.brightness import NAMES
from stages.normalize import Config

NAME, ORDER = "normalize", 62


def command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="scene.h5 from 'lunargr ingest DEM --images'.")],
    svbrdf: Annotated[
        Path | None, typer.Argument(metavar="[SVBRDF]", help="Reflectance map of the scene, instead of --model.")
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            autocompletion=options.complete_model,
            help="Reflectance model or published set, such as hapke or sato2014_643nm; sato2014: the set nearest to "
            "each image's wavelength. 'lunargr models' lists them.",
        ),
    ] = None,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--parameters",
            metavar="NAME=VALUE,...",
            help="Parameters of --model, such as w=0.3,theta_deg=20; the others keep its values.",
        ),
    ] = None,
    standard_deg: Annotated[
        str,
        typer.Option("--standard", metavar="I,E,G", help="Incidence, emission and phase of the result, deg."),
    ] = "30,0,30",
    max_incidence_deg: Annotated[
        float, typer.Option("--max-incidence", metavar="DEG", help="Mask pixels at a larger local incidence.")
    ] = Config.max_incidence_deg,
    max_emission_deg: Annotated[
        float, typer.Option("--max-emission", metavar="DEG", help="Mask pixels at a larger local emission.")
    ] = Config.max_emission_deg,
    phase_bins_deg: Annotated[
        str | None,
        typer.Option("--phase-bins", metavar="DEG,...", help="Edges of phase bins, each with a mosaic of its own."),
    ] = None,
    angles: Annotated[
        str,
        typer.Option(
            "--angles", metavar="dem|file", help="The terrain's angles, or those that the images' table names."
        ),
    ] = Config.angles,
    level: Annotated[
        bool, typer.Option("--level", help="Bring images in I/F to one level where they overlap; DN always are.")
    ] = Config.level,
    register: options.Register = Config.register,
    leave_out: Annotated[str | None, typer.Option("--leave-out", metavar="ID,...", help="Images to leave out.")] = None,
    geotiff: options.GeoTiff = None,
    no_geotiff: options.NoGeoTiff = False,
    shard: options.Shard = None,
    output: options.OutputFile = Path("normalized.h5"),
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Bring images to a standard geometry with the terrain's angles, with error bars, and make a mosaic of them."""
    config = options.configure(
        Config, locals(),
        parameters=options.read_parameters(parameters),
        standard_deg=options.read_list("--standard", standard_deg, (3,)) or Config.standard_deg,

        phase_bins_deg=options.read_list("--phase-bins", phase_bins_deg) or (),
        leave_out=options.read_names("--leave-out", leave_out),
        geotiff=not no_geotiff, shard=options.parse_shard(shard),
    )  # fmt: skip
    console, to = Console(quiet), options.make_map_output(locals())
    found = normalize.run(scene, svbrdf, to, config, console.progress)
    console.say(
        f"{output}: mosaic of {len(found.images)} images over {found.covered_share:.1%} of the map, {found.mean_images:.1f} a pixel, "
        f"mean {NAMES[found.image_units]} {found.mean:.4f} at {config.standard_deg[0]:g}, {config.standard_deg[1]:g}, {config.standard_deg[2]:g} deg"
    )
    if found.before is None or found.after is None:
        console.say("images do not overlap: their errors are not known")
    else:
        console.say(f"step between overlapping images: {found.before:.1%} rms before, {found.after:.1%} after")
    for plane, (mean, rms) in found.angles.items():
        word = plane.removesuffix("_deg")
        console.say(f"{word} of the files less the terrain's: mean {mean:+.3f} deg, rms {rms:.3f} deg")
    rows = [(name, f"{gain:.4g}", f"{offset:.4g}", f"{std:.1%}") for name, gain, offset, std in found.images]
    console.table("images", ("image", "gain", "offset", "std"), rows)
