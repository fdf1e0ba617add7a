"""Pictures of a diagnosis: crops with what differs in them, what each cause changes, the residual against geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from stages.common import page
from stages.common.page.pictures import chart_svg, coloured, new_chart, photo_uri
from stages.diagnose.data.sites import Site
from stages.diagnose.judge.state import State
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import lit_mask

CROPS = 3
CURVE_SITES = 8
BINS = 12
GREY, DIVERGING = "gray", "RdBu_r"

Map = NDArray[np.float32]


@dataclass(frozen=True)
class Crop:
    """One image of one place, all (H, W); residuals and causes in percent of the mean brightness, NaN where not judged."""

    name: str
    measured: Map
    simulated: Map
    before: Map
    after: Map
    causes: dict[str, Map]


def draw(state: State, image_ids: Sequence[str]) -> dict[str, list[Markup]]:
    """The pictures by the chapter of the page that they belong to."""
    crops = _crops(state, image_ids)
    return {"differs": _differs(crops), "causes": _footprints(crops), "geometry": _curves(state)}


def _models(state: State, site: Site) -> tuple[Chain, Chain]:
    """Under the nominal model as it is fitted alone, and under everything that was named."""
    return state.beside([]).chain(site, []), state.nominal.chain(site, state.base)


def _crops(state: State, image_ids: Sequence[str]) -> list[Crop]:
    """The first place under a few of its images, from the first to the last."""
    site = state.sites[0]
    first, last = _models(state, site)
    lit, simulated, bare = lit_mask(last), last.predict(), first.predict()
    read = (site.read - site.offset[:, None, None]) / site.gain[:, None, None]
    without = {
        cause.effect.name: state.nominal.chain(site, [e for e in state.base if e is not cause.effect]).predict()
        for cause in state.named
    }
    found = []
    for k in dict.fromkeys(np.linspace(0, site.count - 1, CROPS).round().astype(int)):
        mask = lit[k].numpy()
        if not mask.any():
            continue
        measured, model = site.image[k].numpy(), simulated[k].numpy()
        level = float(measured[mask].mean())

        def residual(image: Map, model: Map, mask: Any = mask, level: float = level) -> Map:
            scale = float((image[mask] * model[mask]).sum() / max(float((model[mask] ** 2).sum()), 1e-20))
            return np.where(mask, 100 * (image - scale * model) / level, np.nan)

        found.append(
            Crop(
                image_ids[int(site.frames[k])],
                measured,
                model,
                residual(read[k].numpy(), bare[k].numpy()),
                residual(measured, model),
                {n: np.where(mask, 100 * (model - other[k].numpy()) / level, np.nan) for n, other in without.items()},
            )
        )
    return found


def _differs(crops: Sequence[Crop]) -> list[Markup]:
    if not crops:
        return []
    top = max(float(np.nanpercentile(c.measured, 99.5)) for c in crops)
    wide = _reach([c.before for c in crops])
    parts = []
    for c in crops:
        shown = (
            (c.measured, "measured", GREY, 0.0, top),
            (c.simulated, "simulated", GREY, 0.0, top),
            (c.before, "residual before anything was named", DIVERGING, -wide, wide),
            (c.after, "residual with everything that was named", DIVERGING, -wide, wide),
        )
        parts.append(page.heading(c.name))
        parts.append(page.crops(_small(v, f"{words}, {c.name}", words, k, a, b) for v, words, k, a, b in shown))
    bars = [
        (page.colour_bar(0.0, top, GREY, ""), "measured and simulated, I/F"),
        (page.colour_bar(-wide, wide, DIVERGING, "%"), "measured minus simulated, of the mean brightness"),
    ]
    said = (
        "One place under several of its images. Each residual is after the best gain; before: with the nominal model fitted alone and "
        "the image where it was read. Ground that is not judged (shadow, grazing light, no data) is left out."
    )
    return [*parts, page.named_bars(bars), page.paragraph(said, "soft")]


def _footprints(crops: Sequence[Crop]) -> list[Markup]:
    """What each cause changes in the simulated images."""
    parts: list[Markup] = []
    for name in crops[0].causes if crops else ():
        wide = _reach([c.causes[name] for c in crops])
        words = name.replace("_", " ")
        parts.append(page.heading(f"What {words} changes in the simulated image"))
        parts.append(
            page.crops(_small(c.causes[name], f"{words}, {c.name}", c.name, DIVERGING, -wide, wide) for c in crops)
        )
        bar = page.colour_bar(-wide, wide, DIVERGING, "%")
        parts.append(page.named_bars([(bar, "with it minus without it, of the mean brightness")]))
    return parts


def _reach(maps: Sequence[Map]) -> float:
    """Half the span of a symmetric colour scale."""
    known = np.concatenate([np.abs(m[np.isfinite(m)]) for m in maps])
    return max(float(np.percentile(known, 97)), 1e-3) if len(known) else 1.0


def _small(values: Map, alt: str, caption: str, colours: str, low: float, high: float) -> Markup:
    return page.picture(photo_uri(coloured(values, low, high, colours), quality=92), caption, alt)


def _curves(state: State) -> list[Markup]:
    """Mean residual against each angle, before and after: evidence only."""
    fields: dict[str, list[Map]] = {"incidence, deg": [], "emission, deg": [], "phase, deg": [], "slope, deg": []}
    left: tuple[list[Map], list[Map]] = ([], [])
    for site in state.sites[:CURVE_SITES]:
        models = _models(state, site)
        mask = lit_mask(models[1])
        if not bool(mask.any()):
            continue
        light = models[1].state
        angles = [np.degrees(a.numpy()) for a in (light.angles.incidence, light.angles.emission, light.angles.phase)]
        slope = np.degrees(np.arctan(np.hypot(*(s.numpy() for s in light.slopes))))
        for known, field in zip(fields.values(), [*angles, np.broadcast_to(slope, mask.shape)], strict=True):
            known.append(field[mask.numpy()])
        mean = float(site.image[mask].mean())
        for out, chain in zip(left, models, strict=True):
            predicted = chain.predict()
            scale = float((site.image[mask] * predicted[mask]).sum() / predicted[mask].square().sum().clamp(min=1e-20))
            out.append(((site.image - scale * predicted) / mean)[mask].numpy())
    if not left[0]:
        return []
    before, after = (100 * np.concatenate(part) for part in left)
    charts = [_curve(name, np.concatenate(parts), before, after) for name, parts in fields.items()]
    said = (
        "Mean residual in bins of equal numbers of pixels: grey before, blue after. Nothing is decided by these curves."
    )
    return [page.grid(charts), page.paragraph(said, "soft")]


def _curve(name: str, x: Map, before: Map, after: Map) -> Markup:
    figure, axes = new_chart(4.2, 2.8)
    edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))
    place = np.clip(np.searchsorted(edges, x) - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(place, minlength=max(len(edges) - 1, 1))
    known = count > 0
    middle = np.bincount(place, x, minlength=len(count))[known] / count[known]
    for label, colour, values in (("before", "#8a929c", before), ("after", "#3b8ecb", after)):
        level = np.bincount(place, values, minlength=len(count))[known] / count[known]
        axes.plot(middle, level, color=colour, marker="o", markersize=2.5, label=label)
    axes.axhline(0, color="#8a929c", linewidth=0.6)
    axes.set(xlabel=name, ylabel="mean residual, %")
    return page.chart(chart_svg(figure, f"curve-{name.split(',')[0]}"), f"against {name.split(',')[0]}")
