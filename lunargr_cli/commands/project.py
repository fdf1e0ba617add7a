"""`lunargr project`: crops.h5 -> pairs.h5."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from lunargr_cli.options import Output, Overwrite, Parts, Quiet, ResumeParts, Scheduler, Shard, in_parts, parse_shard

if TYPE_CHECKING:
    from stages.project import Registered

NAME, ORDER = "project", 40


class CLASS(typer.core.TyperCommand):
    """``--register`` alone means ``--register shift``: typer knows no option whose value may be left out."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        full = []
        for k, word in enumerate(args):
            full.append(word)
            if word == "--register" and args[k + 1 : k + 2] not in (["shift"], ["affine"]):
                full.append("shift")
        return super().parse_args(ctx, full)


def command(
    crops: Annotated[Path, typer.Argument(help="crops.h5 from 'lunargr sample'.")],
    scene: Annotated[
        Path | None, typer.Option("--scene", help="scene.h5, where it is no longer where crops.h5 says.")
    ] = None,
    register: Annotated[
        str | None,
        typer.Option(
            "--register",
            metavar="[shift|affine]",
            help="Take off how far each image lies from its rendering: one shift (default), or linear over the ground.",
        ),
    ] = None,
    max_shift: Annotated[
        float, typer.Option("--max-shift", help="How far to search when registering, px of the scene's grid.")
    ] = 8.0,
    regions_csv: Annotated[
        Path | None, typer.Option("--shifts", metavar="CSV", help="Also write each region's own shift to a table.")
    ] = None,
    exact: Annotated[
        bool, typer.Option("--exact", help="Keep all digits of float32, not those that matter: three times the size.")
    ] = False,
    shard: Shard = None,
    output: Output = Path("pairs.h5"),
    scheduler: Scheduler = None,
    resume: ResumeParts = False,
    parts: Parts = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Orthorectify the images onto the crops; add the Sun, the camera and the terrain's horizon."""
    from lunargr_cli.console import Console
    from schemas import ConfigError, check_output
    from stages import project

    console = Console(quiet)
    if regions_csv is not None:
        if register is None:
            raise typer.BadParameter("needs --register", param_hint="--shifts")
        check_output(regions_csv, [crops, output], overwrite)
    config = project.Config(
        scene=str(scene) if scene else None,
        shard=parse_shard(shard),
        register=register,
        max_shift=max_shift,
        exact=exact,
    )
    if in_parts(scheduler, resume, parts, shard):
        from lunargr_cli.fanout.stages import run_project

        if regions_csv is not None:
            raise ConfigError(
                "--shifts: parts do not keep the regions' own shifts; leave out --scheduler and --resume."
            )
        how = {"scheduler": scheduler, "overwrite": overwrite, "say": console.say, "progress": console.progress}
        found = run_project(crops, output, config, parts, **how)
    else:
        found = project.run(crops, output, config, overwrite, console.progress)
    (i0, i1), (e0, e1) = found.incidence_deg, found.emission_deg
    console.say(
        f"{output}: {found.pairs} pairs, {found.valid_share:.1%} of pixels valid, {found.shadowed_share:.1%} of these in cast shadow; "
        f"incidence {i0:.1f}-{i1:.1f} deg, emission {e0:.1f}-{e1:.1f} deg"
    )
    for entry in found.registered:
        if entry.field.refused:
            console.say(f"not registered: image '{entry.image_id}' stays where it was: {entry.field.refused}")
    rows = [
        (
            r.image_id,
            f"{r.field.coefficients[0, 0]:+.2f}",
            f"{r.field.coefficients[1, 0]:+.2f}",
            f"{r.field.sigma:.2f}",
            f"{r.field.scatter:.2f}",
            f"{r.field.correlation:.2f}",
            f"{r.field.used}/{r.field.regions}",
        )
        for r in found.registered
        if r.field.accepted
    ]
    if rows:
        names = ("image", "east px", "south px", "sigma px", "scatter px", "correlation", "regions")
        console.table(f"registration ({register}): the image lay there, and was moved back", names, rows)
    if regions_csv is not None:
        _write_regions(regions_csv, found.registered)


def _write_regions(path: Path, registered: Iterable[Registered]) -> None:
    """One row per region: where it is on the scene's grid, and what it said."""
    import csv

    from schemas.files.outputs import atomic_path

    with atomic_path(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["image_id", "row", "col", "dx_px", "dy_px", "sigma_px", "correlation", "lead", "refused"])
        for image in registered:
            for row, col, s in image.regions:
                numbers = (f"{v:.4f}" for v in (s.dx, s.dy, s.sigma, s.correlation, s.lead))
                out.writerow([image.image_id, row, col, *numbers, s.refused])
