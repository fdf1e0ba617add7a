"""`lunargr inspect FILE`: what an artefact is, who made it, from what; what a raster, image or camera of others is."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lunargr_cli.console import Console, write_out
from lunargr_cli.options import Json, Overwrite
from schemas.files.outputs import json_targets, write_json
from stages.common.runner import prepared

if TYPE_CHECKING:
    from schemas.provenance import Step

NAME, ORDER = "inspect", 90
SHOWN = 16  # digits of a SHA-256 on the terminal; --json has all


def command(
    file: Annotated[
        Path,
        typer.Argument(
            help="An artefact of lunargr (HDF5, GeoTIFF, EXR), or any DEM, image, ISIS cube or camera model."
        ),
    ],
    json_file: Json = None,
    overwrite: Overwrite = False,
) -> None:
    """Show what a file holds. An artefact: its variables, and the commands and inputs that made it. A DEM, an image or a
    camera: its size, ground, time and Sun, and how fine a DEM it needs.
    """
    with prepared([file], json_targets(json_file), overwrite):
        _inspect(file, json_file)


def _inspect(file: Path, json_file: Path | None) -> None:
    from schemas.provenance import chain
    from schemas.rasters import raster_kind

    if not _is_ours(file):
        _describe_foreign(file, json_file)
        return
    content = _describe_raster(file) if raster_kind(file) else _describe_artefact(file)
    steps = chain(file)
    if json_file is not None:
        result = {
            "file": file.name,
            "schema": content.schema,
            "attributes": content.attributes,
            content.kind: content.parts,
        }
        write_json(json_file, result | {"chain": [asdict(s) for s in steps]})
    console = Console()
    write_out(f"{file}: {content.title}\n")
    rows = [(n, *(v for v in part.values() if isinstance(v, str))) for n, part in content.parts.items()]
    console.table(content.kind, ("name", *content.columns), rows)
    shown = {k: v for k, v in content.attributes.items() if k != "provenance"}
    console.table("attributes", ("name", "value"), shown.items())
    console.table("made by, in this order", ("file", "command", "version", "seed", "sha256"), [_row(s) for s in steps])


def _is_ours(file: Path) -> bool:
    """Whether a lunargr command wrote a file; HDF5 and missing files count too: the artefacts' reader says what is wrong."""
    from schemas.provenance import chain
    from schemas.rasters import raster_kind

    if raster_kind(file):
        return chain(file)[-1].record is not None
    return not file.is_file() or file.suffix.lower() in (".h5", ".hdf5", ".nc")


def _describe_foreign(file: Path, json_file: Path | None) -> None:
    from stages.physics.images.describe import describe

    title, facts = describe(file)
    if json_file is not None:
        write_json(json_file, {"file": file.name, "title": title, "facts": facts})
    write_out(f"{file}: {title}\n")
    Console().table("facts", ("name", "value"), facts.items())


@dataclass(frozen=True)
class Content:
    """What a file holds.

    kind : of its parts, 'variables' or 'bands'; parts : by name, what is text in them stands in the table under ``columns``
    """

    schema: str
    title: str
    kind: str
    columns: tuple[str, ...]
    parts: dict[str, dict[str, Any]]
    attributes: dict[str, Any]


def _describe_artefact(file: Path) -> Content:
    from schemas import open_artefact, read_kind

    schema = read_kind(file)
    with open_artefact(file, schema) as data:
        attributes = {k: (v.tolist() if hasattr(v, "tolist") else v) for k, v in data.attrs.items()}
        variables = {
            name: {
                "dims": list(schema[name].dims) if name in schema else [],
                "shape": list(data[name].shape),
                "size": "x".join(map(str, data[name].shape)) or "scalar",
                "dtype": str(data[name].dtype),
            }
            for name in data
            if hasattr(data[name], "shape")
            and not str(data[name].attrs.get("NAME", "")).startswith("This is a netCDF dim")
        }
    title = f"{schema.title} ('{schema.name}', version {schema.version}, written by 'lunargr {schema.stage}')"
    return Content(schema.name, title, "variables", ("shape", "type"), variables, attributes)


def _describe_raster(file: Path) -> Content:
    from schemas.rasters import read_raster

    raster = read_raster(file)
    size = "x".join(map(str, raster.shape))
    bands = {
        name: {"shape": list(raster.shape), "size": size, "unit": unit, "dtype": kind}
        for name, unit, kind in raster.bands
    }
    return Content(raster.kind, raster.kind, "bands", ("shape", "unit", "type"), bands, dict(raster.tags))


def _row(step: Step) -> tuple[object, ...]:
    record = step.record
    if record is None:
        return step.name, "(given)", "", "", step.sha256[:SHOWN]
    how = record["command"] or f"(Python) {record['schema']} {json.dumps(record['config'], sort_keys=True)}"
    return step.name, how, record["version"], "" if record["seed"] < 0 else record["seed"], step.sha256[:SHOWN]
