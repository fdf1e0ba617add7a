"""The diagnosis as one HTML file: what differs, how much of it is what, the causes, and what else was looked at."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from schemas import atomic_path
from stages.diagnose.model.nominal import lit_mask
from stages.diagnose.result.answer import Answer, describe
from stages.diagnose.search.state import State
from stages.effects import get_effect

BUDGET = (
    ("named", "named causes", "a"),
    ("common_to_images", "common to the images of a place", "b"),
    ("own_to_image", "each image's own", "c"),
    ("noise", "noise", "d"),
)


def write_page(path: Path, answer: Answer, state: State | None, image_ids: Sequence[str]) -> None:
    """Write the file."""
    from jinja2 import Environment

    said = answer.to_json()
    for cause in said["causes"]:
        effect = get_effect(cause["effect"])
        cause |= {
            "title": effect.title,
            "mechanism": effect.mechanism,
            "reference": effect.reference,
            "values": describe(cause["parameters"]),
            "gain": _percent(cause["held_out_gain_percent"], cause["held_out_low"], cause["held_out_high"]),
            "others": ", ".join(n for n in cause["group"] if n != cause["effect"]) or "-",
            "rms": _change(cause["residual_rms_before"], cause["residual_rms_after"]),
        }
    for form in said["registration"]:
        form["text"] = _percent(form["held_out_gain_percent"], form["low"], form["high"])
    budget = [
        {"name": name, "percent": 100 * said["budget"][key], "colour": colour}
        for key, name, colour in BUDGET
        if said["budget"].get(key) is not None
    ]
    held = said["held_out"]
    template = files("stages.diagnose.result").joinpath("page.html.j2").read_text(encoding="utf-8")
    text = (
        Environment(autoescape=True, trim_blocks=True)
        .from_string(template)
        .render(
            answer=said,
            budget=budget,
            nominal=answer.form or answer.config.get("checkpoint") or answer.config.get("model", ""),
            pictures=_pictures(state, image_ids) if state is not None else {},
            held_out=_percent(held["gain_percent"], held["gain_percent_low"], held["gain_percent_high"]),
        )
    )
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _percent(value: float | None, low: float | None, high: float | None) -> str:
    if value is None:
        return "not scored"
    return f"{value:.1f} %" if low is None or high is None else f"{value:.1f} % ({low:.1f} .. {high:.1f})"


def _change(before: float | None, after: float | None) -> str:
    return "-" if before is None or after is None else f"{before:.4f} to {after:.4f}"


def _pictures(state: State, image_ids: Sequence[str]) -> dict[str, str]:
    return {"residuals": _residuals(state, image_ids), "binned": _binned(state)}


def _models(state: State, site):
    """Simulated images under the nominal model as it was fitted alone and under everything that was named."""
    reference = state.reference or state.nominal
    return reference.chain(site, []), state.nominal.chain(site, state.base)


def _residuals(state: State, image_ids: Sequence[str]) -> str:
    figure, axes = _figure(3, 4)
    site = state.sites[0]
    first, last = _models(state, site)
    for row, k in zip(axes, np.linspace(0, site.count - 1, 3).round().astype(int), strict=True):
        mask = lit_mask(last)[k].numpy()
        aligned, read = (
            site.image[k].numpy(),
            ((site.read - site.offset[:, None, None]) / site.gain[:, None, None])[k].numpy(),
        )
        simulated, bare = last.predict()[k].numpy(), first.predict()[k].numpy()
        level = float(np.mean(aligned[mask])) if mask.any() else 1.0

        def residual(image, model, mask=mask, level=level):
            scale = (
                float((image[mask] * model[mask]).sum() / max((model[mask] ** 2).sum(), 1e-20)) if mask.any() else 1.0
            )
            return np.where(mask, 100 * (image - scale * model) / level, np.nan)

        before, after = residual(read, bare), residual(aligned, simulated)
        top = float(np.percentile(aligned, 99)) or 1.0
        wide = max(float(np.nanpercentile(np.abs(before), 97)), 1e-3) if mask.any() else 1.0
        name = image_ids[int(site.frames[k])]
        shown = (
            (aligned, f"{name}: measured, I/F", 0, top, "gray"),
            (simulated, "simulated, I/F", 0, top, "gray"),
            (before, "residual before, %", -wide, wide, "RdBu_r"),
            (after, "residual after, %", -wide, wide, "RdBu_r"),
        )
        for axis, (data, title, low, high, colours) in zip(row, shown, strict=True):
            drawn = axis.imshow(data, vmin=low, vmax=high, cmap=colours)
            figure.colorbar(drawn, ax=axis, fraction=0.046)
            axis.set_title(title, fontsize=8)
            axis.set_axis_off()
    return _encode(figure)


def _binned(state: State) -> str:
    figure, axes = _figure(1, 4, 3.0)
    values: dict[str, list[Any]] = {"incidence, deg": [], "emission, deg": [], "phase, deg": [], "slope, deg": []}
    left: list[list[Any]] = [[], []]
    for site in state.sites[:8]:
        first, last = _models(state, site)
        mask = lit_mask(last)
        angles = last.state.angles
        slope = np.degrees(np.arctan(np.hypot(*(s.numpy() for s in last.state.slopes))))
        fields = [np.degrees(a.numpy()) for a in (angles.incidence, angles.emission, angles.phase)]
        for name, field in zip(values, [*fields, np.broadcast_to(slope, mask.shape)], strict=True):
            values[name].append(field[mask.numpy()])
        mean = float(site.image[mask].mean()) if bool(mask.any()) else 1.0
        for out, chain in zip(left, (first, last), strict=True):
            predicted = chain.predict()
            scale = float((site.image[mask] * predicted[mask]).sum() / predicted[mask].square().sum().clamp(min=1e-20))
            out.append(((site.image - scale * predicted) / mean)[mask].numpy())
    for axis, (name, parts) in zip(axes[0], values.items(), strict=True):
        x = np.concatenate(parts)
        if not len(x):
            continue
        edges = np.unique(np.quantile(x, np.linspace(0, 1, 13)))
        place = np.clip(np.searchsorted(edges, x) - 1, 0, max(len(edges) - 2, 0))
        count = np.bincount(place, minlength=max(len(edges) - 1, 1))
        middle = np.bincount(place, x, minlength=len(count)) / np.maximum(count, 1)
        for label, r in zip(("before", "after"), left, strict=True):
            level = np.bincount(place, np.concatenate(r), minlength=len(count)) / np.maximum(count, 1)
            axis.plot(middle[count > 0], 100 * level[count > 0], ".-", label=label)
        axis.axhline(0, color="0.6", lw=0.8)
        axis.set_xlabel(name)
    axes[0][0].set_ylabel("mean residual, %")
    axes[0][0].legend()
    return _encode(figure)


def _figure(rows: int, columns: int, height: float = 2.9):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.3 * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _encode(figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


__all__ = ["write_page"]
