"""`lunargr project`: crops.h5 -> pairs.h5."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from lunargr_cli import options
from lunargr_cli.console import Console
from stages import project
from stages.project import Config

if TYPE_CHECKING:
    from stages.project.summary import Registered, Resemblance

NAME, ORDER = "project", 40
BRIGHTEST = 1.0  # I/F of a white Lambert surface that faces the Sun


class RegisterTakesNoValue(typer.core.TyperCommand):
    """``--register`` alone means ``--register constant``: typer knows no option whose value may be left out."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Write out what ``--register`` alone means."""
        full = []
        for k, word in enumerate(args):
            full.append(word)
            if word == "--register" and not _is_value(args[k + 1 : k + 2]):
                full.append("constant")
        return super().parse_args(ctx, full)


CLASS = RegisterTakesNoValue


def _is_value(following: list[str]) -> bool:
    """Whether what follows --register is its value: also where it is a wrong one, which then gets named."""
    return bool(following and re.fullmatch("[a-z]+", following[0]) and not Path(following[0]).exists())


def command(
    crops: Annotated[Path, typer.Argument(help="crops.h5 from 'lunargr sample'.")],
    scene: Annotated[
        Path | None, typer.Option("--scene", help="scene.h5, if it moved since crops.h5 was written.")
    ] = None,
    register: Annotated[
        str | None,
        typer.Option(
            "--register",
            metavar="[constant|affine|field]",
            help="Align each image with its rendering. The value sets the most flexible correction allowed: one shift "
            "(constant, the default), a linear one, or a smooth field.",
        ),
    ] = None,
    max_shift: Annotated[
        float, typer.Option("--max-shift", help="Search radius of --register, px of the scene's grid.")
    ] = Config.max_shift,
    shifts: Annotated[
        Path | None,
        typer.Option("--shifts", metavar="CSV", help="Also write the shift of each block to a table."),
    ] = None,
    exact: Annotated[
        bool, typer.Option("--exact", help="Write float32, not packed 16-bit numbers; the file is twice as large.")
    ] = Config.exact,
    shard: options.Shard = None,
    output: options.OutputFile = Path("pairs.h5"),
    scheduler: options.Scheduler = None,
    resume: options.ResumeParts = False,
    parts: options.Parts = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Orthorectify the images onto the crops; add Sun, camera and terrain horizon."""
    config = options.configure(Config, locals(), scene=str(scene) if scene else None, shard=options.parse_shard(shard))
    console, to = Console(quiet), options.make_output(locals(), shifts=shifts)
    summary = project.run(crops, to, config, console.say, console.progress)
    (i0, i1), (e0, e1) = summary.incidence_deg, summary.emission_deg
    console.say(
        f"{output}: {summary.pairs} pairs, {summary.valid_share:.1%} of pixels valid, {summary.shadowed_share:.1%} of these in cast shadow; "
        f"incidence {i0:.1f}-{i1:.1f} deg, emission {e0:.1f}-{e1:.1f} deg"
    )
    if summary.negative:
        shares = ", ".join(f"{name} {share:.1%}" for name, share in list(summary.negative.items())[:5])
        console.say(
            f"I/F below 0 in {len(summary.negative)} images: {shares}{' ...' if len(summary.negative) > 5 else ''} of their valid "
            "pixels; check the dark level that calibration took off"
        )
    if summary.registered:
        _say_registered(console, summary.registered)
    _say_resemblances(console, summary.resemblances, summary.units)


def _say_resemblances(console: Console, resemblances: Sequence[Resemblance], units: str) -> None:
    """A line per image: how much it resembles its rendering; a warning where that is what chance gives."""
    rows = [
        (
            r.image_id,
            *("-" if math.isnan(v) else f"{v:.2f}" for v in (r.correlation, r.chance, r.contrast)),
            f"{r.mean:.4g}",
        )
        for r in resemblances
        if not math.isnan(r.mean)
    ]
    if rows:
        mean = "mean I/F" if units == "iof" else "mean DN"
        console.table("images beside their renderings", ["image", "correlation", "chance", "contrast", mean], rows)
    for r in resemblances:
        if r.is_chance:
            opposite = (
                "; it shows its negative: heights or the Sun may be reversed" if -r.correlation > r.chance else ""
            )
            console.say(
                f"warning: image '{r.image_id}' resembles the rendering of its ground no more than chance gives "
                f"({r.correlation:.2f}, chance {r.chance:.2f}){opposite}; check its place, its Sun and the DEM, or try --register"
            )
        if units == "iof" and r.mean > BRIGHTEST:
            console.say(
                f"warning: image '{r.image_id}' has a mean I/F of {r.mean:.4g}, more than a white surface has; its units may be dn"
            )


def _say_registered(console: Console, registered: Sequence[Registered]) -> None:
    """A line per image: what was taken off, how sure that is, and how long it took."""
    from stages.project.register import combined_share

    for entry in registered:
        if entry.field.refused:
            console.say(f"not registered: image '{entry.image_id}' stays where it was: {entry.field.refused}")
    rows = [
        (
            r.image_id,
            r.field.form,
            f"{r.field.mean[0]:+.2f}",
            f"{r.field.mean[1]:+.2f}",
            f"{r.field.sigma:.2f}",
            f"{r.field.scatter:.2f}",
            f"{r.field.share:.2f} +- {r.field.share_error:.2f}" if r.field.share else "-",
            f"{r.field.held_out:.0%}",
            f"{r.field.correlation:.2f}",
            f"{r.field.used}/{r.field.regions}",
            f"{r.seconds:.1f}",
        )
        for r in registered
        if r.field.accepted
    ]
    if rows:
        names = ["image", "form", "east px", "south px", "sigma px", "scatter px", "relief", "held out"]
        names += ["correlation", "blocks", "seconds"]
        console.table("registration: the image lay there, and was moved back", names, rows)
    share, error, images = combined_share(registered)
    if images:
        console.say(
            f"relief displacement: share {share:.3f} +- {error:.3f} of h tan(emission) in {images} images (not orthorectified: 1)"
        )
