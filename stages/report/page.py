"""The page: one HTML file without scripts or links to anything outside, readable in light and dark."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape

STYLE = """
:root { color-scheme: light dark; --back: #fbfaf8; --card: #ffffff; --text: #1d2126; --soft: #626a75; --line: #e2e0da;
  --accent: #1b6ca8; --good: #2c7a4b; --bad: #a8434b; --zebra: #f4f2ee; }
@media (prefers-color-scheme: dark) { :root { --back: #14171b; --card: #1b1f25; --text: #e4e6e9; --soft: #9aa3ae;
  --line: #2e343c; --accent: #6cb4e8; --good: #6fc491; --bad: #ee8b92; --zebra: #20252c; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--back); color: var(--text); font: 16px/1.55 system-ui, -apple-system, "Segoe UI",
  Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 2.2rem 1.25rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .35rem; letter-spacing: -.01em; }
h2 { font-size: 1.3rem; margin: 2.8rem 0 .5rem; padding-top: .9rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.5rem 0 .4rem; }
p { margin: .4rem 0 .8rem; max-width: 46rem; }
.soft { color: var(--soft); }
nav { display: flex; flex-wrap: wrap; gap: .35rem 1rem; margin: 1rem 0 1.4rem; font-size: .92rem; }
a { color: var(--accent); text-decoration: none; } a:hover { text-decoration: underline; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(185px, 1fr)); gap: .8rem; margin: 1.1rem 0; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: .8rem 1rem; }
.card b { display: block; font-size: 1.45rem; font-weight: 650; line-height: 1.25; font-variant-numeric: tabular-nums; }
.card span { color: var(--soft); font-size: .88rem; line-height: 1.35; display: block; }
.good { color: var(--good); } .bad { color: var(--bad); }
.scroll { overflow-x: auto; margin: .6rem 0 1rem; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; min-width: 50%; }
caption { text-align: left; color: var(--soft); padding-bottom: .35rem; font-size: .9rem; }
th { text-align: left; font-weight: 600; border-bottom: 2px solid var(--line); padding: .35rem .8rem .35rem 0; white-space: nowrap; }
td { border-bottom: 1px solid var(--line); padding: .32rem .8rem .32rem 0; vertical-align: top; }
td.n, th.n { text-align: right; white-space: nowrap; }
tr.best td { font-weight: 650; } tr:hover td { background: var(--zebra); }
figure { margin: .6rem 0 1.2rem; } figcaption { color: var(--soft); font-size: .88rem; margin-top: .4rem; max-width: 46rem; }
img { max-width: 100%; height: auto; border-radius: 6px; display: block; }
.grid { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(310px, 1fr)); }
.grid figure { margin: 0; }
.crops { display: grid; gap: .4rem; grid-auto-flow: column; grid-auto-columns: minmax(96px, 1fr); overflow-x: auto; }
.crops figure { margin: 0; } .crops img { width: 100%; image-rendering: pixelated; border-radius: 4px; }
.crops figcaption { font-size: .76rem; line-height: 1.25; margin: .2rem 0 .5rem; }
.bar { height: 10px; border-radius: 5px; margin-top: .5rem; border: 1px solid var(--line); }
.ends { display: flex; justify-content: space-between; font-size: .8rem; color: var(--soft); font-variant-numeric: tabular-nums; }
.chart svg { width: 100%; height: auto; max-width: 760px; color: var(--text); }
details { margin: .35rem 0; } summary { cursor: pointer; }
code, pre { font: .82rem/1.45 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .7rem .9rem; }
footer { margin-top: 3rem; color: var(--soft); font-size: .85rem; }
@media print { .crops { grid-auto-columns: 1fr; } nav { display: none; } }
"""


@dataclass
class Section:
    """A part of the page: ``body`` is finished HTML."""

    title: str
    body: list[str] = field(default_factory=list)

    def add(self, *parts: str) -> None:
        self.body.extend(parts)


def paragraph(text: str, kind: str = "") -> str:
    return f"<p{_class(kind)}>{escape(text)}</p>"


def cards(items: Iterable[tuple[str, str, str]]) -> str:
    """Headline numbers: (value, what it is, '' | 'good' | 'bad')."""
    inner = "".join(
        f'<div class="card"><b{_class(kind)}>{escape(value)}</b><span>{escape(what)}</span></div>'
        for value, what, kind in items
    )
    return f'<div class="cards">{inner}</div>'


def table(caption: str, columns: Sequence[str], rows: Sequence[Sequence[str]], best: int | None = None) -> str:
    """A table; columns whose cells all look like numbers are set right; row ``best`` stands out."""
    numeric = [all(row[k][:1] in "-+.0123456789" for row in rows) for k in range(len(columns))]
    kinds = ["n" if n else "" for n in numeric]
    head = "".join(f"<th{_class(kind)}>{escape(c)}</th>" for c, kind in zip(columns, kinds, strict=True))
    body = []
    for number, row in enumerate(rows):
        cells = "".join(f"<td{_class(kind)}>{escape(cell)}</td>" for cell, kind in zip(row, kinds, strict=True))
        body.append(f"<tr{_class('best' if number == best else '')}>{cells}</tr>")
    return (
        f'<div class="scroll"><table><caption>{escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def picture(source: str, caption: str, alt: str = "", bar: str = "") -> str:
    """A figure with an image (a data URI) and, where given, its colour bar."""
    return (
        f'<figure><img src="{source}" alt="{escape(alt or caption, quote=True)}">{bar}'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def chart(svg: str, caption: str) -> str:
    return f'<figure class="chart">{svg}<figcaption>{escape(caption)}</figcaption></figure>'


def grid(figures: Iterable[str]) -> str:
    return f'<div class="grid">{"".join(figures)}</div>'


def crops(figures: Iterable[str]) -> str:
    return f'<div class="crops">{"".join(figures)}</div>'


def disclosure(summary: str, text: str) -> str:
    """Text that opens on a click."""
    return f"<details><summary>{escape(summary)}</summary><pre>{escape(text)}</pre></details>"


def page(title: str, subtitle: str, head: Sequence[str], sections: Sequence[Section], footer: str) -> str:
    """The whole file."""
    links = "".join(f'<a href="#s{k}">{escape(s.title)}</a>' for k, s in enumerate(sections))
    parts = "".join(
        f'<section id="s{k}"><h2>{escape(s.title)}</h2>{"".join(s.body)}</section>' for k, s in enumerate(sections)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body><main>"
        f'<header><h1>{escape(title)}</h1><p class="soft">{escape(subtitle)}</p></header>'
        f"<nav>{links}</nav>{''.join(head)}{parts}<footer>{escape(footer)}</footer></main></body></html>\n"
    )


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
