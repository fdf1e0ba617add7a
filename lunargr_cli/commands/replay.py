"""`lunargr replay FILE`: the commands that make an artefact again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lunargr_cli.console import write_out
from schemas.errors import ArtefactError

if TYPE_CHECKING:
    from schemas.provenance import Step

NAME, ORDER = "replay", 91


def command(file: Annotated[Path, typer.Argument(help="Any artefact of lunargr: HDF5, GeoTIFF or EXR.")]) -> None:
    """Print the commands that make a file again, as a shell script."""
    from schemas import open_artefact, read_kind
    from schemas.provenance import chain
    from schemas.rasters import raster_kind

    if not raster_kind(file):
        open_artefact(file, read_kind(file)).close()
    steps = chain(file)
    if steps[-1].record is None:
        raise ArtefactError(
            f"{file}: expected an artefact that holds the command of its run, found none; nothing to replay."
        )
    write_out("\n".join(script(steps)))


def script(steps: Sequence[Step]) -> Iterator[str]:
    """A shell script: inputs first, each with its hash; what no command is known for is said in comments."""
    yield "set -eu"
    folder, done = "", set()
    for step in steps:
        record = step.record
        mark = f"  # sha256 {step.sha256}" if step.sha256 else ""
        if record is None:
            yield f"# needs {step.name}{mark}"
            continue
        seed = "" if record["seed"] < 0 else f", seed {record['seed']}"
        yield f"# {step.name}: {record['schema']}, lunargr {record['version']}{seed}{mark.replace('  #', ',')}"
        if not record["command"]:
            yield f"# made from Python, by the stage's run(), with {json.dumps(record['config'], sort_keys=True)}"
            continue
        if record["folder"] != folder:
            folder = record["folder"]
            yield f"cd {shlex.quote(folder)}"
        if record["command"] not in done:  # one command may leave several files
            yield record["command"]
        done.add(record["command"])
