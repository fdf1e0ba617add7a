"""The options that commands share, each spelled and explained once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from schemas.errors import ConfigError

Output = Annotated[Path, typer.Option("--output", "-o", help="File to write.", show_default=True)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on where an interrupted run stopped.")]
Shard = Annotated[
    str | None,
    typer.Option("--shard", metavar="I/N", help="Do only part I of N (1-based); join the parts with 'lunargr merge'."),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of every random choice.")]
Device = Annotated[str, typer.Option("--device", help="cpu, cuda, cuda:1, ... or auto.")]
BodyOption = Annotated[
    str | None,
    typer.Option(
        "--body", metavar="NAME|METRES", help="Body by name, or its radius in metres (default: the Moon, 1737400)."
    ),
]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write the result as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]


def parse_shard(text: str | None) -> tuple[int, int]:
    """'2/8' -> (1, 8): zero-based index and count; None -> (0, 1). Raises ConfigError."""
    if text is None:
        return 0, 1
    first, _, last = text.partition("/")
    if first.isdigit() and last.isdigit() and 1 <= int(first) <= int(last):
        return int(first) - 1, int(last)
    raise ConfigError(f"--shard: expected I/N with 1 <= I <= N, found '{text}'.")
