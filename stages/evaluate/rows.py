"""The rows of the table: what is rendered, what of it is fitted on the train split, what on the scored crop itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.evaluate.renderers import Constant, Predictor, Renderer, learned, published
from stages.physics.formation.chain import Extension

# Of Hapke's law: coherent backscatter and porosity stay off, as in the published lunar sets.
HAPKE_FREE = ("w", "b", "c", "Bs0", "hs", "theta")
GAIN_OFFSET = "gain_offset"
TITLES = {
    "learned": "learned reflectance",
    "learned_gain_offset": "learned, gain + offset per crop",
    "learned_extended": "learned, with the diagnosed effects",
    "learned_extended_gain_offset": "learned, diagnosed effects, gain + offset per crop",
    "global": "same model, one global coefficient set",
    "global_gain_offset": "global set, gain + offset per crop",
    "global_extended": "global set, with the diagnosed effects",
    "global_extended_gain_offset": "global set, diagnosed effects, gain + offset per crop",
    "kernels": "lunar kernels, one global coefficient set",
    "kernels_gain_offset": "global lunar kernels, gain + offset per crop",
    "hapke_fitted": "Hapke, one global parameter set fitted",
    "hapke_fitted_gain_offset": "fitted Hapke, gain + offset per crop",
    "lunar_lambert": "Lunar-Lambert, albedo fitted",
    "lunar_lambert_gain_offset": "Lunar-Lambert, gain + offset per crop",
    "hapke_raw": "Hapke, published parameters",
    "hapke_minmax": "Hapke, min-max matched per crop (the paper's baseline)",
    "hapke_gain": "Hapke, gain per crop",
    "hapke_gain_offset": "Hapke, gain + offset per crop",
}
# (rows, renderer): each is scored as it is and with the crop's own least-squares gain and offset
EXTENDED = ("learned_extended", "global_extended")
SOURCES = ("learned", *EXTENDED, "global", "kernels", "hapke_fitted", "lunar_lambert")


@dataclass
class Row:
    """A line of the table: a renderer and how its crops are matched to the measured ones.

    Several training runs make several lines of one name; ``run`` counts them.
    """

    name: str
    renderer: Renderer
    how: str | None = None
    run: int = 0


def layout(extended: bool) -> list[tuple[str, str, str | None]]:
    """The rows of the table: (name, renderer, matching per crop)."""
    rows: list[tuple[str, str, str | None]] = []
    for source in SOURCES:
        if extended or source not in EXTENDED:
            rows += [(source, source, None), (f"{source}_gain_offset", source, GAIN_OFFSET)]
    return [
        *rows,
        ("hapke_raw", "hapke", None),
        ("hapke_minmax", "hapke", "minmax"),
        ("hapke_gain", "hapke", "gain"),
        ("hapke_gain_offset", "hapke", GAIN_OFFSET),
    ]


def freedom(name: str) -> str:
    """What a row takes from the scored crop itself: 'none', 'gain', 'gain_offset' or 'minmax'."""
    return next(how or "none" for row, _, how in layout(True) if row == name)


def make_renderers(predictors: Sequence[Predictor], extensions: Sequence[Extension]) -> dict[str, Renderer]:
    """Everything that is compared, before anything is fitted; a network's from its second training run on as NAME:RUN."""
    model = predictors[0].model
    start = Constant(np.array([p.default for p in model.parameters]))
    made = []
    for run, predictor in enumerate(predictors):
        network, spread = learned(predictor)
        made.append(Renderer(run_name("learned", run), model, network, spread=spread))
        made.append(Renderer(run_name("learned_extended", run), model, network, tuple(extensions)))
    made.append(Renderer("global", model, start))
    made.append(Renderer("global_extended", model, start, tuple(extensions)))
    for name in ("kernels", "hapke", "lunar_lambert"):
        baseline, values = published(name)
        made.append(Renderer(name, baseline, Constant(values)))
        if name == "hapke":
            made.append(Renderer("hapke_fitted", baseline, Constant(values)))
    return {renderer.name: renderer for renderer in made}


def make_rows(renderers: dict[str, Renderer], runs: int, extended: bool, only: Sequence[str] = ()) -> list[Row]:
    """The rows (or those in ``only``), a learned one for each training run."""
    return [
        Row(name, renderers[run_name(source, run)], how, run)
        for name, source, how in layout(extended)
        for run in range(runs if source.startswith("learned") else 1)
        if not only or name in only
    ]


def run_name(source: str, run: int) -> str:
    """The renderer of one training run."""
    return f"{source}:{run + 1}" if run else source
