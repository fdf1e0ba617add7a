"""The chapters of a diagnosis, for the page of `diagnose` and for `report`: what differs, how much of it is what, what
each named cause takes away, what was not named and why, and which image would settle the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from stages.common import page
from stages.common.page.sentences import Number, Sentence, compared, counted, error_change, listed, words

BUDGET = {
    "named": "the causes that were named",
    "common_to_images": "common to all images of a place (ground and heights)",
    "own_to_image": "own to each image",
    "noise": "noise",
}
VERDICTS = {
    "nothing_significant": "Nothing significant is missing from the simulation.",
    "unexplained": "Something is missing from the simulation that nothing in the catalogue explains.",
    "cannot_tell": "These data cannot tell whether something is missing from the simulation.",
}
SAME = (
    "The residual before and after is that without and with the cause, all else that is fitted, the nominal coefficients among it, "
    "fitted along in both. The gain is that on ground that the cause was not fitted to, with its 95 % interval."
)


@dataclass(frozen=True)
class About:
    """An effect's entry in the catalogue. separate : the image that would tell it from others"""

    title: str
    mechanism: str
    reference: str
    separate: str


Chapter = tuple[str, list[Markup]]


def conclusions(result: dict[str, Any]) -> list[Sentence]:
    """Sentences on what the simulation lacks, how much better it is with it, and what these data could not tell."""
    verdict = result.get("verdict", "")
    sentence = str(result.get("sentence") or VERDICTS.get(verdict, verdict) or "The diagnosis holds no verdict.")
    if verdict == "named" and not result.get("sentence"):
        sentence = f"The simulation lacks {listed([c['effect'] for c in result.get('causes', [])])}."
    data = result.get("data") or {}
    if data.get("pairs"):
        sentence = f"Diagnosis of {data['pairs']:,} pairs of {counted(data.get('sites', 0), 'place')}: {sentence}"
    found = [(sentence, "")]
    held_out = result.get("held_out") or {}
    if result.get("causes") and held_out.get("gain_percent") is not None:
        on = f"{held_out['pairs']:,} unseen pairs" if held_out.get("pairs") else "unseen pairs"
        if held_out.get("sites"):
            on += f" of {counted(held_out['sites'], 'place')}"
        on += ", each pixel with an albedo of its own"
        found.append(compared("With what was named, the simulation", "the simulation without it", held_out, on))
    if result.get("blind"):
        found.append((_blind_sentence(result["blind"]), ""))
    return found


def numbers(result: dict[str, Any]) -> list[Number]:
    """The first cause's value with its 95 % interval, and what all causes together change."""
    found = []
    for cause in (result.get("causes") or [])[:1]:
        for name, v in list(cause.get("parameters", {}).items())[:1]:
            if v.get("value") is not None and v.get("error") is not None:
                unit = {"1": "", "degree": " deg"}.get(v.get("unit", "1"), f" {v.get('unit')}")
                low, high = (v["value"] + side * 1.96 * v["error"] for side in (-1, 1))
                what = f"{words(cause['effect'])} ({words(name.removesuffix('_deg').removesuffix('_px'))}), named by the diagnosis"
                found.append(Number(f"{v['value']:.3g}{unit}", f"95 %: {low:.3g} .. {high:.3g}{unit}", what))
    held_out = result.get("held_out") or {}
    if result.get("causes") and held_out.get("gain_percent") is not None:
        found.append(error_change(held_out, "squared error of the simulation with what the diagnosis named"))
    return found


def chapters(
    result: dict[str, Any],
    about: Callable[[str], About] | None = None,
    drawn: Mapping[str, Sequence[Markup]] | None = None,
) -> list[Chapter]:
    """Titles and parts. about : gives an effect's entry by name; drawn : pictures by the chapter that they belong to.

    Every key of ``result`` but the verdict may be missing: other versions leave some out.
    """
    drawn = drawn or {}
    found = [
        ("What differs", list(drawn.get("differs", ()))),
        ("How much of it is what", _budget(result.get("budget") or {})),
        ("What each named cause takes away", [*_causes(result.get("causes") or [], about), *drawn.get("causes", ())]),
        ("What got no name, and why", _rejected(result)),
        ("What would settle the rest", _unsettled(result, about)),
        ("Residual against geometry", list(drawn.get("geometry", ()))),
    ]
    return [(title, parts) for title, parts in found if parts]


def _blind_sentence(effects: list[str]) -> str:
    return f"Whether any of these is there, the data cannot tell: {listed(effects)}."


def _budget(budget: dict[str, float | None]) -> list[Markup]:
    shares = [(BUDGET.get(name, words(name)), 100 * share) for name, share in budget.items() if share is not None]
    if not shares:
        return []
    note = (
        "Shares of the variance of the relative residual under the nominal model. What the images of a place have in common is albedo and "
        "relief that the model lacks; a part of it may be a cause that these data cannot tell from ground. The squared error on top of the "
        "page gives each pixel an albedo of its own, so what the images have in common is not in it."
    )
    return [page.budget(shares), page.paragraph(note, "soft")]


def _causes(causes: Sequence[dict[str, Any]], about: Callable[[str], About] | None) -> list[Markup]:
    if not causes:
        return []
    columns = ["cause", "parameters", "rms of the relative residual", "gain on held-out ground", "p (family-wise)",
               "explains these data as well"]  # fmt: skip
    parts = [page.table("", columns, [_cause(c) for c in causes]), page.paragraph(SAME, "soft")]
    if about is not None:
        for cause in causes:
            known = about(cause["effect"])
            parts.append(
                page.paragraph(f"{words(cause['effect']).capitalize()}: {known.mechanism} ({known.reference})")
            )
    return parts


def _cause(cause: dict[str, Any]) -> list[str]:
    values = []
    for name, v in cause.get("parameters", {}).items():
        unit = "" if v.get("unit", "1") == "1" else f" {v['unit']}"
        value = f"{name} = {formatted(v['value'], '.3g')} +- {formatted(v['error'], '.1g')}{unit}"
        values.append(value.replace(" ", "\u00a0"))
    before, after = (formatted(cause.get(f"residual_rms_{k}"), ".4f") for k in ("before", "after"))
    others = [words(name) for name in cause.get("group", []) if name != cause["effect"]]
    gain = [cause.get(k) for k in ("held_out_gain_percent", "held_out_low", "held_out_high")]
    return [
        words(cause["effect"]),
        "; ".join(values) or "-",
        f"{before} to {after}",
        percent(*gain),
        formatted(cause.get("p_family_wise"), ".2g"),
        ", ".join(others) or "-",
    ]


def _rejected(result: dict[str, Any]) -> list[Markup]:
    parts = []
    if ordinary := result.get("ordinary"):
        found = [_cause(c)[:2] for c in ordinary]
        parts.append(page.table("Surely there, of a size that any data have", ["effect", "parameters"], found))
    rows = [
        [words(r["effect"]), formatted(r.get("gain_nats"), ".0f"), str(r.get("why", "-"))]
        for r in result.get("rejected") or []
    ]
    if rows:
        parts.append(
            page.table("Evidence that got no name", ["effect", "gain on held-out ground, nats", "why not"], rows)
        )
    forms = [
        [str(r["form"]), percent(r.get("held_out_gain_percent"), r.get("low"), r.get("high"))]
        for r in result.get("registration") or []
    ]
    if forms:
        caption = "Where the images lie: the squared residual that each form of displacement takes away on places it was not fitted to"
        parts.append(page.table(caption, ["form", "gain"], forms))
    return parts


def _unsettled(result: dict[str, Any], about: Callable[[str], About] | None) -> list[Markup]:
    rows = []
    for cause in result.get("causes") or []:
        others = [words(n) for n in cause.get("group", []) if n != cause["effect"]]
        if cause.get("to_separate") and others:
            rows.append([f"{words(cause['effect'])}, or {' or '.join(others)}", str(cause["to_separate"])])
    parts = []
    blind = result.get("blind") or []
    if about is not None:
        rows += [[f"whether there is {words(n)}", about(n).separate or "-"] for n in blind]
    elif blind:
        parts.append(page.paragraph(_blind_sentence(blind)))
    if rows:
        parts.insert(0, page.table("", ["what is open", "what would tell"], rows))
    return parts


def formatted(value: float | None, form: str) -> str:
    """A number in Python's format, "-" where there is none."""
    return "-" if value is None else format(value, form)


def percent(value: float | None, low: float | None, high: float | None) -> str:
    """'+2.1 % (1.5 .. 2.6)'"""
    if value is None:
        return "not scored"
    return f"{value:+.1f} %" if low is None or high is None else f"{value:+.1f} % ({low:+.1f} .. {high:+.1f})"
