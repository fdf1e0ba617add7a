"""What the simulation gets wrong, as a section of the report."""

from __future__ import annotations

from typing import Any

from stages.common import page
from stages.common.page.diagnosis import chapters, conclusions


def diagnosis(result: dict[str, Any]) -> page.Section:
    """The chapters of the diagnosis's own page, without its pictures."""
    section = page.Section("Diagnosis")
    section.add(*(page.paragraph(text) for text, _ in conclusions(result)))
    for title, parts in chapters(result):
        section.add(page.heading(title), *parts)
    return section
