"""What the simulation gets wrong: causes, the budget of the residual, what was rejected, what could not be told."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from stages.common import page
from stages.report.conclusions import bounds
from stages.report.conclusions import diagnosis as sentences

SHARES = {
    "named": "the causes that were named",
    "common_to_images": "common to all images of a place (ground and heights)",
    "own_to_image": "own to each image",
    "noise": "noise",
}


def diagnosis(result: dict[str, Any]) -> page.Section:
    """Every key but the verdict may be missing: other versions leave some out."""
    section = page.Section("Diagnosis")
    section.add(*(page.paragraph(text) for text, _ in sentences(result)))
    causes = result.get("causes", [])
    if causes:
        header = ["cause", "parameters", "p (family-wise)", "gain, nats", "MSE of unseen pairs lowered by, %",
                  "residual rms", "not to be told apart from"]  # fmt: skip
        section.add(page.table("Causes", header, [_cause(c) for c in causes]))
    for cause in causes:
        if len(cause.get("group", [])) > 1 and cause.get("to_separate"):
            section.add(page.paragraph(f"To separate {_words(cause['effect'])}: {cause['to_separate']}", "soft"))
    section.add(*_budget(result.get("budget") or {}))
    rejected = [
        [_words(r["effect"]), _number(r.get("gain_nats"), ".1f"), str(r.get("why", "-"))]
        for r in result.get("rejected") or []
    ]
    if rejected:
        section.add(page.table("Evidence that got no name", ["effect", "gain, nats", "why"], rejected))
    return section


def _cause(cause: dict[str, Any]) -> list[str]:
    values = []
    for name, v in cause.get("parameters", {}).items():
        unit = "" if v.get("unit", "1") == "1" else f" {v['unit']}"
        values.append(f"{name} = {_number(v['value'], '.4g')} +- {_number(v['error'], '.2g')}{unit}")
    gain = {"gain_percent_low": cause.get("held_out_low"), "gain_percent_high": cause.get("held_out_high")}
    percent = cause.get("held_out_gain_percent")
    others = [_words(name) for name in cause.get("group", []) if name != cause["effect"]]
    return [
        _words(cause["effect"]),
        "; ".join(values) or "-",
        _number(cause.get("p_family_wise"), ".2g"),
        _number(cause.get("gain_nats"), ".1f"),
        "-" if percent is None else f"{percent:+.1f} ({bounds(gain)})",
        f"{_number(cause.get('residual_rms_before'), '.3g')} to {_number(cause.get('residual_rms_after'), '.3g')}",
        ", ".join(others) or "-",
    ]


def _budget(budget: dict[str, float | None]) -> list[Markup]:
    rows = [
        [SHARES.get(name, _words(name)), f"{100 * share:.1f}"] for name, share in budget.items() if share is not None
    ]
    if not rows:
        return []
    return [page.table("Where the residual's variance comes from", ["part", "share, %"], rows)]


def _words(name: str) -> str:
    return name.replace("_", " ")


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
