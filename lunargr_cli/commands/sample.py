"""`lunargr sample`: scene.h5 -> crops.h5."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from schemas.errors import ConfigError
from stages import sample
from stages.sample import Config

NAME, ORDER = "sample", 30
DEFAULT_SPLIT = "/".join(f"{100 * share:g}" for share in Config.split)


def command(
    scene: Annotated[Path, typer.Argument(help="scene.h5 from 'lunargr ingest'.")],
    crop: Annotated[
        int | None,
        typer.Option(
            "--crop", min=1, max=options.MOST, help="Crop size in pixels, a multiple of 16 (default: the scene's)."
        ),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count",
            min=1,
            max=options.MOST,
            help="Number of crops, or of sites with --stack (default: 100 per image).",
        ),
    ] = None,
    density: Annotated[
        float | None, typer.Option("--density", help="Crops per km2 of each image's valid positions.")
    ] = None,
    stack: Annotated[
        bool,
        typer.Option(
            "--stack",
            help="Crop all images that cover each chosen site. Sites lie side by side while there is room.",
        ),
    ] = Config.stack,
    tile_m: Annotated[
        float | None, typer.Option("--tile-m", help="Edge of a ground tile of the split, m (default: up to 4 crops).")
    ] = None,
    split: Annotated[str, typer.Option("--split", help="Shares of train/validation/test.")] = DEFAULT_SPLIT,
    seed: options.Seed = Config.seed,
    shard: options.Shard = None,
    output: options.OutputFile = Path("crops.h5"),
    scheduler: options.Scheduler = None,
    parts: options.Parts = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Choose crop centres and split them by ground tile; training, validation and test share no ground."""
    config = options.configure(Config, locals(), split=_shares(split), shard=options.parse_shard(shard))
    console, to = Console(quiet), options.make_output(locals())
    audit = sample.run(scene, to, config, console.say, console.progress)
    rows = [(p.name, p.pairs, p.images, p.tiles, f"{p.ground_km2:.2f}", f"{p.shared_km2:.2f}") for p in audit]
    console.table("split by ground tile", ("part", "pairs", "images", "tiles", "ground km2", "shared km2"), rows)


def _shares(text: str) -> tuple[float, float, float]:
    """'80/10/10' -> (0.8, 0.1, 0.1). Raises ConfigError."""
    try:
        shares = [float(v) for v in text.split("/")]
        total = sum(shares)
        first, second, third = (v / total for v in shares)
    except (ValueError, ZeroDivisionError):
        raise ConfigError(f"--split: expected three shares like 80/10/10, found '{text}'.") from None
    return first, second, third
