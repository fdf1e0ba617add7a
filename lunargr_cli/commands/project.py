"""`lunargr project`: crops.h5 -> pairs.h5."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.options import Output, Overwrite, Quiet, Shard, parse_shard

NAME, ORDER = "project", 40


def command(
    crops: Annotated[Path, typer.Argument(help="crops.h5 from 'lunargr sample'.")],
    scene: Annotated[
        Path | None, typer.Option("--scene", help="scene.h5, where it is no longer where crops.h5 says.")
    ] = None,
    shard: Shard = None,
    output: Output = Path("pairs.h5"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Orthorectify the images onto the crops; add the Sun, the camera and the terrain's horizon."""
    from lunargr_cli.console import Console
    from stages import project

    console = Console(quiet)
    config = project.Config(scene=str(scene) if scene else None, shard=parse_shard(shard))
    found = project.run(crops, output, config, overwrite, console.progress)
    (i0, i1), (e0, e1) = found.incidence_deg, found.emission_deg
    console.say(
        f"{output}: {found.pairs} pairs, {found.valid_share:.1%} of pixels valid, {found.shadowed_share:.1%} of these in cast shadow; "
        f"incidence {i0:.1f}-{i1:.1f} deg, emission {e0:.1f}-{e1:.1f} deg"
    )
