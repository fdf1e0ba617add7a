"""`lunargr models`: the reflectance models, their parameters, published sets and other programs' conventions; the cameras."""

from __future__ import annotations

import inspect
from typing import Annotated

import typer

from lunargr_cli.console import Console, write_out
from lunargr_cli.options import Json, Overwrite
from schemas.files.outputs import json_targets, write_json
from schemas.later import without
from stages.common.runner import prepared

NAME, ORDER = "models", 85


def command(
    name: Annotated[str | None, typer.Argument(help="A model for its parameters; nothing lists all models.")] = None,
    sets: Annotated[bool, typer.Option("--sets", help="List the published parameter sets.")] = False,
    conventions: Annotated[
        bool, typer.Option("--conventions", help="List the conventions that 'lunargr convert' knows.")
    ] = False,
    cameras: Annotated[bool, typer.Option("--cameras", help="List the camera models that lunargr reads.")] = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the reference part of docs/photometry.md.")
    ] = False,
    json_file: Json = None,
    overwrite: Overwrite = False,
) -> None:
    """List the reflectance models: parameters, bounds, units, defaults, reference, reciprocal or not."""
    with without("torch"):  # half of this command's time; what is listed here needs none of it
        from stages.physics.photometry import catalogue, get_model

        chosen = None if name is None else get_model(name)
        if json_file is not None:
            with prepared([], json_targets(json_file), overwrite):
                write_json(json_file, catalogue.as_dict())
        if markdown:
            write_out(catalogue.markdown())
        elif sets:
            _print_sets(catalogue.parameter_sets(None if chosen is None else chosen.name))
        elif conventions:
            _print_conventions(None if chosen is None else chosen.name)
        elif cameras:
            _print_cameras()
        elif chosen is None:
            _print_all()
        else:
            _print_model(chosen)


def _print_all() -> None:
    from stages.physics.photometry import get_model, model_names

    models = [get_model(n) for n in model_names()]
    rows = [(m.name, len(m.parameters), "yes" if m.reciprocal else "no", m.formula, m.reference) for m in models]
    Console().table("reflectance models, in I/F", ("name", "params", "reciprocal", "formula", "reference"), rows)
    write_out(
        "lunargr models NAME shows bounds, units and defaults; --sets published values, --conventions other programs."
    )


def _print_model(model) -> None:  # type: ignore[no-untyped-def]
    from stages.physics.photometry import catalogue

    write_out(f"{model.name}: {model.title}\n")
    write_out(f"I/F = {model.formula}")
    write_out(f"source: {model.reference}")
    write_out(
        f"reciprocal: {'yes' if model.reciprocal else 'no'}; linear in its parameters: {'yes' if model.linear else 'no'}"
    )
    write_out(f"maps that 'lunargr train' predicts by default: {', '.join(model.choose_maps())}")
    console = Console()
    rows = [
        (p.name, p.unit, f"{p.lower:.6g}", f"{p.upper:.6g}", f"{p.default:.6g}", p.description)
        for p in model.parameters
    ]
    console.table("parameters", ("name", "unit", "lower", "upper", "default", "what"), rows)
    if catalogue.parameter_sets(model.name):
        _print_sets(catalogue.parameter_sets(model.name))
    if len(catalogue.related_conventions(model.name)) > 1:
        _print_conventions(model.name)


def _print_sets(sets) -> None:  # type: ignore[no-untyped-def]
    from stages.physics.photometry import catalogue

    rows = [(s.name, s.model, catalogue.values_text(s), s.description, s.reference) for s in sets]
    Console().table("published sets", ("name", "model", "values", "what", "source"), rows)


def _print_cameras() -> None:
    from stages.physics.cameras import cameras

    rows = [
        (c.kind, ", ".join(c.answers_to), str(inspect.getdoc(inspect.getmodule(c))).split("\n")[0]) for c in cameras()
    ]
    Console().table("cameras", ("kind", "`type` or `name_model` in its file", "what"), rows)


def _print_conventions(model: str | None) -> None:
    from stages.physics.photometry import catalogue

    rows = [
        (c.name, c.model, ", ".join(f"{n} [{u}]" if u != "1" else n for n, u in c.quantities), c.returns)
        for c in catalogue.related_conventions(model)
    ]
    Console().table("conventions", ("name", "model here", "bands", "formula gives"), rows)
