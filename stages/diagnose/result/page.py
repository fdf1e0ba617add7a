"""The diagnosis as one HTML file, of the same parts as the page of `lunargr report`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from markupsafe import Markup

from schemas import atomic_path
from stages.common import page
from stages.common.page.diagnosis import About, chapters, conclusions, numbers
from stages.diagnose.judge.state import State
from stages.diagnose.result.answer import Answer
from stages.diagnose.result.drawings import draw
from stages.effects import get_effect


def write_page(path: Path, answer: Answer, state: State | None, image_ids: Sequence[str]) -> None:
    """Write the file; without a state there are no pictures."""
    said = answer.to_json()
    drawn: dict[str, list[Markup]] = draw(state, image_ids) if state is not None and state.sites else {}
    sections = [page.Section(title, parts) for title, parts in chapters(said, _about, drawn)]
    large = numbers(said)
    head = [*([page.headline(large)] if large else []), page.conclusions(conclusions(said))]
    nominal = answer.config.get("checkpoint") or answer.config.get("model", "")
    subtitle = f"made by lunargr {version('lunargr')} from {answer.pairs} pairs in {answer.images} images; nominal model: {nominal}"
    text = page.page(
        "What the simulation gets wrong",
        subtitle,
        head,
        sections,
        f"Verdict: {answer.verdict}. Every number is also in the JSON of this diagnosis.",
    )
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _about(name: str) -> About:
    effect = get_effect(name)
    return About(effect.title, effect.mechanism, effect.reference, effect.separate)


__all__ = ["write_page"]
