"""One self-contained HTML file: the verdict, the evidence per cause, and pictures of what is left."""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from schemas import atomic_path
from stages.diagnose.answer import describe, parameters
from stages.diagnose.nominal import lit_mask
from stages.effects import get_effect

if TYPE_CHECKING:
    from stages.diagnose import Result
    from stages.diagnose.data import Site
    from stages.diagnose.state import Search

STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:72em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse}td,th{padding:.25em .8em;border-bottom:1px solid #ccc;text-align:left;vertical-align:top}
img{max-width:100%}.verdict{font-size:1.25em;background:#eef3f8;padding:.6em 1em;border-left:4px solid #357}"""


def write_report(path: Path, result: Result) -> None:
    """Write the HTML file."""
    answer = result.answer
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><title>lunargr diagnose</title>",
        f"<style>{STYLE}</style><h1>What the simulation gets wrong</h1>",
        f"<p class='verdict'><b>{answer.verdict}</b>: {html.escape(answer.sentence())}</p>",
        f"<p>{answer.pairs} pairs of {answer.sites} sites in {answer.images} images.</p>",
        _causes(answer),
    ]
    if result.round is not None:
        parts += ["<h2>Measured, simulated, residual</h2>", _picture(_residuals(result))]
        parts.append(
            "<p>Before: the nominal model as it was fitted alone. Each site's mean albedo is taken out of all residuals.</p>"
        )
        parts += ["<h2>Residual against geometry</h2>", _picture(_binned(result))]
        parts += ["<h2>Evidence for every effect, after what was named</h2>", _evidence(result)]
        s = result.structure
        parts.append(
            f"<p>Structure left, over noise: fields {s.fields:.3f}, lines {s.lines:.3f}, columns {s.columns:.3f}; "
            f"strongest single frequency {s.peak:.1f} times the median.</p>"
        )
    if answer.blind:
        parts.append(f"<p>These data could not show: {', '.join(answer.blind)}.</p>")
    h = answer.held_out
    if h.pairs:
        parts.append(
            f"<p>On {h.pairs} unseen pairs the mean squared error goes from {h.nominal:.4g} to {h.extended:.4g}: "
            f"{h.gain:.1f} % ({h.low:.1f} .. {h.high:.1f}).</p>"
        )
    with atomic_path(path) as partial:
        partial.write_text("\n".join(parts))


def _causes(answer) -> str:
    if not answer.causes:
        return ""
    rows = []
    for c in answer.causes:
        effect = get_effect(c.effect.name)
        cells = (
            f"<b>{c.effect.name}</b><br>{html.escape(effect.title)}",
            html.escape(describe(parameters(c))),
            f"{c.p:.1e}",
            f"{c.gain:.0f} &plusmn; {c.gain_error:.0f}",
            f"{c.rms_before:.3e} &rarr; {c.rms_after:.3e}",
            html.escape(", ".join(c.group)),
            html.escape(f"{effect.mechanism} To separate: {effect.separate}. {effect.reference}."),
        )
        rows.append("<tr>" + "".join(f"<td>{x}</td>" for x in cells) + "</tr>")
    head = ("effect", "parameters", "p, family-wise", "gain, nats", "residual rms", "equally good", "mechanism")
    return "<h2>Causes</h2><table><tr>" + "".join(f"<th>{x}</th>" for x in head) + "</tr>" + "".join(rows) + "</table>"


def _evidence(result: Result) -> str:
    rows = []
    for name, e in sorted(result.round.best.items(), key=lambda x: -x[1].gain):
        rows.append(
            f"<tr><td>{name}</td><td>{e.gain:.1f} &plusmn; {e.gain_error:.1f}</td><td>{e.p:.1e}</td><td>{e.fid:.4f}</td></tr>"
        )
    for name, e in result.round.images.items():
        rows.append(
            f"<tr><td>{name}</td><td>{e.gain:.1f} &plusmn; {e.gain_error:.1f}</td><td>{e.p:.1e}</td><td>{e.fid:.4f}</td></tr>"
        )
    head = "<tr><th>effect</th><th>held-out gain, nats</th><th>p</th><th>size / noise</th></tr>"
    return f"<table>{head}{''.join(rows)}</table>"


def _predictions(state: Search, site: Site) -> tuple[Tensor, Tensor]:
    """(n, H, W) each, the nominal model before any cause and with all of them, at the site's mean brightness."""
    reference = state.reference or state.nominal
    alone = reference.chain(site, [])
    lit = lit_mask(alone)
    level = (site.image * lit).sum()
    both = (alone.predict(), state.nominal.chain(site, state.base).predict())
    first, last = (p * (level / (p * lit).sum().clamp(min=1e-12)) for p in both)
    return first, last


def _residuals(result: Result):
    figure, axes = _figure(3, 4)
    state = result.search
    site = state.sites[0]
    before, after = _predictions(state, site)
    for row, k in zip(axes, np.linspace(0, site.count - 1, 3).round().astype(int), strict=True):
        measured, first, last = site.image[k].numpy(), before[k].numpy(), after[k].numpy()
        top = float(np.percentile(measured, 99))
        wide = 2.5 * float(np.std(measured - last)) or 1e-6
        shown = ((measured, "measured", 0, top), (last, "simulated", 0, top))
        shown += ((measured - first, "residual before", -wide, wide), (measured - last, "residual after", -wide, wide))
        for axis, (data, title, low, high) in zip(row, shown, strict=True):
            axis.imshow(data, vmin=low, vmax=high, cmap="gray" if low == 0 else "RdBu_r")
            axis.set_title(f"{title}, image {int(site.frames[k])}", fontsize=9)
            axis.set_axis_off()
    return figure


def _binned(result: Result):
    figure, axes = _figure(1, 4, 3.2)
    state = result.search
    values: dict[str, list] = {"incidence, deg": [], "emission, deg": [], "phase, deg": [], "slope, deg": []}
    residual: list[list] = [[], []]
    for site in state.sites[:8]:
        chain = state.nominal.chain(site, state.base)
        mask = lit_mask(chain).numpy()
        angles = chain.state.angles
        slope = np.degrees(np.arctan(np.hypot(*(s.numpy() for s in chain.state.slopes))))
        fields = [np.degrees(a.numpy()) for a in (angles.incidence, angles.emission, angles.phase)]
        for name, field in zip(values, [*fields, np.broadcast_to(slope, mask.shape)], strict=True):
            values[name].append(field[mask])
        mean = site.image[lit_mask(chain)].mean()
        for out, predicted in zip(residual, _predictions(state, site), strict=True):
            out.append(((site.image - predicted) / mean).numpy()[mask])
    for axis, (name, parts) in zip(axes[0], values.items(), strict=True):
        x = np.concatenate(parts)
        if not len(x):
            continue
        edges = np.unique(np.quantile(x, np.linspace(0, 1, 13)))
        place = np.clip(np.searchsorted(edges, x) - 1, 0, max(len(edges) - 2, 0))
        for label, r in zip(("before", "after"), residual, strict=True):
            y = np.concatenate(r)
            count = np.bincount(place, minlength=max(len(edges) - 1, 1))
            mean = np.bincount(place, y, minlength=len(count)) / np.maximum(count, 1)
            middle = np.bincount(place, x, minlength=len(count)) / np.maximum(count, 1)
            axis.plot(middle[count > 0], 100 * mean[count > 0], ".-", label=label)
        axis.axhline(0, color="0.6", lw=0.8)
        axis.set_xlabel(name)
    axes[0][0].set_ylabel("mean residual, % of brightness")
    axes[0][0].legend()
    return figure


def _figure(rows: int, columns: int, height: float = 3.0):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _picture(figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'>"
