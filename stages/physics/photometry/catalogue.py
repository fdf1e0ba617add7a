"""Catalogue of models, published parameter sets and conventions: as text, as data and as a page of the docs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any, TypeVar

from stages.physics.photometry.base import get_model, model_names
from stages.physics.photometry.conventions import Convention, conventions
from stages.physics.photometry.published import ParameterSet, published_sets

Entry = TypeVar("Entry")


def parameter_sets(model: str | None = None) -> list[ParameterSet]:
    """Published sets, of one model or all."""
    return [s for s in published_sets() if model in (None, s.model)]


def related_conventions(model: str | None = None) -> list[Convention]:
    """Conventions of one model, or those of other programs for all."""
    if model is None:
        return [c for c in conventions() if not c.name.startswith("lunargr:")]
    return [c for c in conventions() if c.model == model]


def values_text(entry: ParameterSet) -> str:
    """'w 0.38, b 0.23, ...' in the units of the parameters."""
    return ", ".join(f"{name} {value:.6g}" for name, value in entry.values.items())


def as_dict() -> dict[str, Any]:
    """Everything, as plain data for JSON."""
    models = [get_model(name) for name in model_names()]
    return {
        "models": {
            m.name: {
                "title": m.title,
                "formula": m.formula,
                "reference": m.reference,
                "reciprocal": m.reciprocal,
                "linear": m.linear,
                "parameters": [asdict(p) for p in m.parameters],
            }
            for m in models
        },
        "sets": {s.name: asdict(s) for s in published_sets()},
        "conventions": {
            c.name: {
                "model": c.model,
                "quantities": [{"name": n, "unit": u} for n, u in c.quantities],
                "returns": c.returns,
                "implied": c.implied,
                "reference": c.reference,
            }
            for c in conventions()
        },
    }


def markdown() -> str:
    """The reference part of the photometry page: every model, set and convention."""
    lines = ["## Models", "", "|model|parameters|reciprocal|source|", "|---|---|---|---|"]
    models = [get_model(name) for name in model_names()]
    alike = _grouped(
        (f"`{m.name}`", (", ".join(p.name for p in m.parameters), "yes" if m.reciprocal else "no", m.reference))
        for m in models
    )
    lines += [f"|{', '.join(names)}|{'|'.join(rest)}|" for rest, names in alike.items()]
    lines += ["", "## Published parameter sets", "", "|sets|model|source|", "|---|---|---|"]
    sets = _grouped((f"`{s.name}`", (f"`{s.model}`", s.reference)) for s in published_sets())
    lines += [f"|{', '.join(names)}|{'|'.join(rest)}|" for rest, names in sets.items()]
    lines += ["", "## Conventions of other programs", ""]
    lines += ["|convention|model here|bands, in the program's order|formula gives|implies|source|"]
    lines += ["|---|---|---|---|---|---|"]
    for c in related_conventions():
        bands = ", ".join(f"{n} [{u}]" if u != "1" else n for n, u in c.quantities)
        implied = ", ".join(f"{n} = {v:g}" for n, v in c.implied.items()) or "-"
        lines.append(f"|`{c.name}`|`{c.model}`|{bands}|{c.returns}|{implied}|{c.reference}|")
    return "\n".join(lines)


def _grouped(entries: Iterable[tuple[str, Entry]]) -> dict[Entry, list[str]]:
    """Names by what they share, in the order of the first name."""
    found: dict[Entry, list[str]] = {}
    for name, entry in entries:
        found.setdefault(entry, []).append(name)
    return found
