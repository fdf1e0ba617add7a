"""`lunargr inspect FILE`: what an artefact is, who made it, from what."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lunargr_cli.console import Console, write_out
from lunargr_cli.options import Json, Overwrite

if TYPE_CHECKING:
    from schemas.provenance import Step

NAME, ORDER = "inspect", 90


def command(
    file: Annotated[Path, typer.Argument(help="Any artefact of lunargr.")],
    json_file: Json = None,
    overwrite: Overwrite = False,
) -> None:
    """Say what an artefact is, who made it and from what; check it against its schema."""
    from schemas import open_artefact, read_kind, write_json
    from schemas.provenance import chain

    schema = read_kind(file)
    with open_artefact(file, schema) as data:
        attributes = {k: (v.tolist() if hasattr(v, "tolist") else v) for k, v in data.attrs.items()}
        variables = {
            name: {
                "dims": list(schema[name].dims) if name in schema else [],
                "shape": list(data[name].shape),
                "dtype": str(data[name].dtype),
            }
            for name in data
            if hasattr(data[name], "shape")
            and not str(data[name].attrs.get("NAME", "")).startswith("This is a netCDF dim")
        }
    steps = chain(file)
    if json_file is not None:
        content = {"file": file.name, "schema": schema.name, "attributes": attributes, "variables": variables}
        write_json(json_file, content | {"chain": [asdict(s) for s in steps]})
    console = Console()
    write_out(
        f"{file}: {schema.title} ('{schema.name}', version {schema.version}, written by 'lunargr {schema.stage}')\n"
    )
    console.table(
        "variables",
        ("name", "shape", "type"),
        [(n, "x".join(map(str, v["shape"])) or "scalar", v["dtype"]) for n, v in variables.items()],
    )
    shown = {k: v for k, v in attributes.items() if k != "provenance"}
    console.table("attributes", ("name", "value"), shown.items())
    console.table("made by, in this order", ("file", "command", "version", "seed", "sha256"), [_row(s) for s in steps])


def _row(step: Step) -> tuple[object, ...]:
    record = step.record
    if record is None:
        return step.name, "(given)", "", "", step.sha256
    how = record["command"] or f"(Python) {record['schema']} {json.dumps(record['config'], sort_keys=True)}"
    return step.name, how, record["version"], "" if record["seed"] < 0 else record["seed"], step.sha256
