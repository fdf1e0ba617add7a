"""`lunargr schema NAME`: what an artefact holds, from its one declaration."""

from __future__ import annotations

from typing import Annotated

import typer

from lunargr_cli.console import Console, write_out
from schemas import SCHEMAS, get_schema

NAME, ORDER = "schema", 91


def command(
    name: Annotated[str | None, typer.Argument(help="scene, crops, pairs, ...; without a name: list all.")] = None,
) -> None:
    """Print what a kind of file holds: dimensions, variables, units, attributes."""
    console = Console()
    if name is None:
        rows = [(s.name, f"lunargr {s.stage}", s.title) for s in SCHEMAS.values()]
        console.table("artefacts", ("name", "written by", "what"), rows)
        return
    schema = get_schema(name)
    write_out(f"{schema.name}, version {schema.version}, written by 'lunargr {schema.stage}': {schema.title}\n")
    console.table("dimensions", ("name", "what"), list(schema.dims.items()))
    variables = []
    for v in schema.variables:
        text = v.description + ("" if v.required else " (optional)")
        if v.flags:
            text += "; " + ", ".join(f"{value} = {meaning}" for meaning, value in v.flags)
        variables.append((v.name, ", ".join(v.dims), v.dtype, " or ".join((v.unit, *v.unit_choices)) or "-", text))
    console.table("variables", ("name", "dims", "type", "unit", "what"), variables)
    console.table("root attributes", ("name", "what"), [(a.name, a.description) for a in schema.attributes])
