"""`lunargr replay FILE`: the commands that make an artefact again."""

from __future__ import annotations

import json
import os
import pkgutil
import re
import shlex
from collections.abc import Iterator, Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lunargr_cli import commands
from lunargr_cli.console import without_steering, write_out
from schemas.command_line import output_of
from schemas.errors import ArtefactError
from schemas.files.inputs import check_input

if TYPE_CHECKING:
    from schemas.provenance import Step

NAME, ORDER = "replay", 91
_PROGRAM = re.compile(r"lunargr|torchrun (--nnodes \d+ )?--nproc-per-node \d+ -m lunargr_cli\.main")


def command(file: Annotated[Path, typer.Argument(help="Any artefact of lunargr: HDF5, GeoTIFF or EXR.")]) -> None:
    """Print the commands that make a file again, as a shell script."""
    from schemas import open_artefact, read_kind
    from schemas.provenance import chain
    from schemas.rasters import raster_kind

    check_input(file)
    if not raster_kind(file):
        open_artefact(file, read_kind(file)).close()
    steps = chain(file)
    if steps[-1].record is None:
        raise ArtefactError(
            f"{file}: expected an artefact that holds the command of its run, found none; nothing to replay."
        )
    write_out("\n".join(script(steps)))


def script(steps: Sequence[Step]) -> Iterator[str]:
    """A shell script: inputs first, each with its hash; steps without a known command are comments.

    The records come from a file that anybody may have written. Raises ArtefactError for commands of other programs and
    for names that a terminal would obey.
    """
    folders = [step.record["folder"] for step in steps if step.record and step.record["command"]]
    yield "set -eu"
    if folders:
        yield "# Give a folder to work in another one. Files that are there already are kept."
        yield f"[ $# -gt 0 ] || set -- {shlex.quote(_plain(folders[0], steps[-1].name))}"
        yield 'cd -- "$1" && here=$PWD'
    folder, done = folders[0] if folders else "", set()
    for step in steps:
        record = step.record
        mark = f"  # sha256 {step.sha256}" if step.sha256 else ""
        if record is None:
            yield _comment(f"needs {step.name}{mark}")
            continue
        seed = "" if record["seed"] < 0 else f", seed {record['seed']}"
        yield _comment(f"{step.name}: {record['schema']}, lunargr {record['version']}{seed}{mark.replace('  #', ',')}")
        if not record["command"]:
            config = json.dumps(record["config"], sort_keys=True)
            yield _comment(f"made from Python, by the stage's run(), with {config}")
            continue
        words, output = _read_command(record["command"], step.name)
        if record["folder"] != folder:
            folder = record["folder"]
            beside = _plain(os.path.relpath(folder or ".", folders[0] or "."), step.name)
            yield 'cd "$here"' + ("" if beside == "." else f"/{shlex.quote(beside)}")
        if (folder, *words) not in done:  # one command may leave several files
            yield f"[ -e {shlex.quote(output)} ] || {shlex.join(words)}"
        done.add((folder, *words))


def _read_command(command: str, made: str) -> tuple[list[str], str]:
    """The words of a recorded command and the output that it names or leaves to its default. Raises ArtefactError.

    made : a file that the command made. The output is not replaced: the words lose --overwrite.
    """
    try:
        words = [word for word in shlex.split(command) if word != "--overwrite"]
    except ValueError:
        words = []
    first = next((k + 2 for k, word in enumerate(words) if word == "-m"), 0) if words[:1] == ["torchrun"] else 1
    name = words[first] if len(words) > first else ""
    if not _PROGRAM.fullmatch(" ".join(words[:first])) or name not in _command_names():
        raise ArtefactError(
            f"{made}: expected a command of lunargr in its record, found '{command[:80]}'; do not run it."
        )
    words = [_plain(word, made) for word in words]
    default = signature(import_module(f"lunargr_cli.commands.{name.replace('-', '_')}").command).parameters.get(
        "output"
    )
    output = output_of(words) or (str(default.default) if default and isinstance(default.default, Path) else made)
    return words, output


def _plain(text: str, made: str) -> str:
    """A word or folder of a record as it stands; without some characters it names another. Raises ArtefactError."""
    if without_steering(text) != text:
        raise ArtefactError(
            f"{made}: expected names without control characters in its record, found {text[:80]!r}; "
            "rename that file or folder, and make the file again."
        )
    return text


def _command_names() -> set[str]:
    return {module.name.replace("_", "-") for module in pkgutil.iter_modules(commands.__path__)}


def _comment(text: str) -> str:
    return f"# {without_steering(text)}"
