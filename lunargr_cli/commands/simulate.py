"""`lunargr simulate`: a scene with known truth, written like real data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lunargr_cli.console import Console, write_out
from lunargr_cli.options import Json, Overwrite, Quiet, make_output
from schemas.errors import ConfigError
from stages import simulate
from stages.common.runner import prepared
from stages.simulate import Config
from stages.simulate.hidden import CHOICES, hidden_from_option

NAME, ORDER = "simulate", 10

_HIDDEN_HELP = (
    "Hidden effect to plant: none, NAME, NAME:PARAMETER=VALUE,... or several joined by '+'. "
    f"Names: {', '.join(CHOICES)}. "
    "[default: dark_bias]"
)


def command(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write the scene into.")] = Path("scene"),
    recipe: Annotated[Path | None, typer.Option("--recipe", help="JSON recipe; the options below override it.")] = None,
    print_recipe: Annotated[bool, typer.Option("--print-recipe", help="Print the full recipe and stop.")] = False,
    size_px: Annotated[
        int | None, typer.Option("--size-px", help=f"Edge of the scene in pixels at --gsd. [default: {Config.size_px}]")
    ] = None,
    extent_m: Annotated[
        float | None, typer.Option("--extent-m", help="Edge of the scene in metres, instead of --size-px.")
    ] = None,
    gsd: Annotated[
        float | None,
        typer.Option(
            "--gsd",
            help=f"Working GSD in metres; the DEM is twice as fine. [default: {Config.gsd:g}]",
        ),
    ] = None,
    images: Annotated[
        int | None, typer.Option("--images", help=f"Number of images. [default: {Config.images}]")
    ] = None,
    units: Annotated[
        str | None,
        typer.Option("--units", help=f"iof, or dn: an unknown gain and offset per image. [default: {Config.units}]"),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option("--sensor", metavar="FILE|NAME", help="Images in DN of a sensor: a JSON file or a preset."),
    ] = None,
    hidden: Annotated[str | None, typer.Option("--hidden", help=_HIDDEN_HELP)] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, max=2**63 - 1, help=f"Seed of every random choice. [default: {Config.seed}]"),
    ] = None,
    overwrite: Overwrite = False,
    json_file: Json = None,
    quiet: Quiet = False,
) -> None:
    """Make a lunar-looking scene with known truth: DEM, map-projected images, images.csv, truth.h5, truth.tif.

    The other commands treat the scene as real data. Only truth.h5 holds the true values.
    """
    changes = {"size_px": size_px, "images": images, "units": units, "sensor": sensor, "seed": seed}
    config = _configure(recipe, changes, gsd, extent_m, hidden)
    if print_recipe:
        write_out(simulate.recipe_json(config))
        return
    console = Console(quiet)
    with prepared([recipe] if recipe else []):
        summary = simulate.run(make_output(locals()), config, console.progress)
    table = summary.table()
    console.table(f"{config.extent / 1000:.2f} km scene in {output}", list(table[0]), [list(r.values()) for r in table])
    planted = " + ".join(summary.hidden) or "none"
    console.say(
        f"{summary.craters} craters, DEM valid {100 * summary.dem_valid:.1f} %, planted: {planted} (recorded in {output / 'truth.h5'})"
    )
    console.say(f"next: lunargr ingest {output / 'dem.tif'} --images {output / 'images.csv'} --gsd {config.gsd:g}")


def _configure(
    recipe: Path | None, changes: dict[str, Any], gsd: float | None, extent_m: float | None, hidden: str | None
) -> Config:
    """The recipe with what the options say in its place. Raises ConfigError, InputError."""
    values = simulate.read_recipe(recipe) if recipe else {}
    if changes["size_px"] is not None and extent_m is not None:
        raise ConfigError("--size-px and --extent-m both set the size; give one of them.")
    if gsd is not None:
        if gsd <= 0:
            raise ConfigError(f"--gsd: expected a number of metres above 0, found {gsd:g}.")
        changes |= {"gsd": gsd, "dem_gsd": gsd / 2}
    values |= {name: value for name, value in changes.items() if value is not None}
    if extent_m is not None:
        step = values.get("gsd", Config.gsd)
        if not (isinstance(step, int | float) and step > 0 and 0 < extent_m < 1e9):
            raise ConfigError(f"--extent-m: expected 0 .. 1e9 m and a --gsd above 0, found {extent_m:g} and {step}.")
        values["size_px"] = round(min(extent_m / step, 2.0**31))
    if hidden is not None:
        values["hidden"] = hidden_from_option(hidden)
    return simulate.make_config(values, str(recipe) if recipe else "options")
