"""The page that `report` and `diagnose` write: one HTML file without links to the network, light and dark. Its only script
is the line that moves a slider.

``parts.html.j2`` holds the parts, ``page.html.j2`` the whole, ``style.css`` the style. Functions here return escaped
HTML.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from stages.common.page import pictures
from stages.common.page.sentences import Number


@functools.cache
def _templates() -> Environment:
    return Environment(
        loader=PackageLoader("stages.common", "page"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )


def _part(name: str, *values: Any) -> Markup:
    return Markup(getattr(_templates().get_template("parts.html.j2").module, name)(*values))


@dataclass
class Section:
    """A part of the page: ``body`` is finished HTML."""

    title: str
    body: list[Markup] = field(default_factory=list)

    def add(self, *parts: Markup) -> None:
        """Put parts at its end."""
        self.body.extend(parts)


def paragraph(text: str, kind: str = "") -> Markup:
    """A paragraph; ``kind`` is its CSS class."""
    return _part("paragraph", text, kind)


def heading(text: str) -> Markup:
    """A heading within a section."""
    return _part("heading", text)


def conclusions(items: Iterable[tuple[str, str]]) -> Markup:
    """Sentences on top of the page: (text, '' | 'good' | 'bad')."""
    return _part("conclusions", list(items))


def headline(numbers: Iterable[Number]) -> Markup:
    """Numbers in large type, side by side."""
    return _part("headline", list(numbers))


def slider(left: str, right: str, names: tuple[str, str], caption: str) -> Markup:
    """Two images (data URIs) of one place on top of each other, and a handle that moves their border."""
    return _part("slider", Markup(left), Markup(right), names, caption)


def folded(summary: str, parts: Iterable[Markup]) -> Markup:
    """Parts that open on a click."""
    return _part("folded", summary, list(parts))


def table(caption: str, columns: Sequence[str], rows: Sequence[Sequence[str]], best: int | None = None) -> Markup:
    """A table; columns whose cells all look like numbers are set right; row ``best`` stands out."""
    numeric = [all(row[k][:1] in "-+.0123456789" for row in rows) for k in range(len(columns))]
    return _part("table", caption, columns, ["n" if n else "" for n in numeric], rows, best)


def picture(source: str, caption: str, alt: str = "", below: str = "") -> Markup:
    """A figure with an image (a data URI) and, where given, finished HTML such as a colour bar below it."""
    return _part("picture", Markup(source), caption, alt, Markup(below))


def picture_pair(above: str, below: str, alt: str, caption: str) -> Markup:
    """Two images (data URIs) of one place, the lower described by ``alt``."""
    return _part("pair", Markup(above), Markup(below), alt, caption)


def named_bars(bars: Iterable[tuple[Markup, str]]) -> Markup:
    """Colour bars side by side, each with what it shows."""
    return _part("named_bars", list(bars))


def chart(svg: str, caption: str) -> Markup:
    """An SVG drawing with a caption."""
    return _part("chart", Markup(svg), caption)


def colour_bar(low: float, high: float, colours: str, unit: str) -> Markup:
    """A gradient of a matplotlib colour map with the numbers at its ends and middle."""
    ends = [f"{pictures.number(v)} {unit}".rstrip() for v in (low, (low + high) / 2, high)]
    return _part("colour_bar", pictures.gradient(colours), ends)


def scale_bar(percent: float, label: str) -> Markup:
    """A line of ``percent`` of the map's width with its length, and an arrow to grid north, which is up."""
    return _part("scale_bar", percent, label)


def link(address: str, text: str) -> Markup:
    """A link to a page beside this one."""
    return _part("link", address, text)


def budget(shares: Iterable[tuple[str, float]]) -> Markup:
    """A bar in parts, each with its name and percent below it."""
    return _part("budget", list(shares))


def grid(figures: Iterable[Markup]) -> Markup:
    """Figures side by side, as many as fit."""
    return _part("grid", list(figures))


def crops(figures: Iterable[Markup]) -> Markup:
    """Small pictures in a row that scrolls."""
    return _part("crops", list(figures))


def disclosure(summary: str, text: str) -> Markup:
    """Text that opens on a click."""
    return _part("disclosure", summary, text)


def page(title: str, subtitle: str, head: Sequence[Markup], sections: Sequence[Section], footer: str) -> str:
    """The whole file."""
    loader = _templates().loader
    assert loader is not None
    style = Markup(loader.get_source(_templates(), "style.css")[0])
    return (
        _templates()
        .get_template("page.html.j2")
        .render(title=title, subtitle=subtitle, head=head, sections=sections, footer=footer, style=style)
    )
