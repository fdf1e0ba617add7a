"""The rows of the table: what is rendered, what of it is fitted on the train split, what on the scored crop itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from torch import Tensor

from stages.evaluate.renderers import Batch, Constant, Renderer, predict, predict_spread
from stages.network.predictor import Predictor
from stages.physics.formation.chain import Extension
from stages.physics.photometry import ReflectanceModel, get_model
from stages.physics.photometry.published import ParameterSet

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
EXTENDED = ("learned_extended", "global_extended")  # rows with the diagnosed effects
# Renderers that are scored as they are and with the crop's own least-squares gain and offset.
SOURCES = ("learned", *EXTENDED, "global", "kernels", "hapke_fitted", "lunar_lambert")


@dataclass
class Row:
    """A line of the table: a renderer and how its crops are matched to the measured ones (``Renderer.image``).

    Several training runs make several lines of one name; ``run`` counts them.
    """

    name: str
    renderer: Renderer
    matching: str | None = None
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
    return next(matching or "none" for row, _, matching in layout(True) if row == name)


def make_renderers(
    predictors: Sequence[Predictor], extensions: Sequence[Extension], published: ParameterSet
) -> dict[str, Renderer]:
    """Everything that is compared, before anything is fitted; a network's from its second training run on as NAME:RUN.

    published : Hapke's parameters
    """
    model = predictors[0].model
    effects = tuple(extensions)
    made = []
    for run, predictor in enumerate(predictors):
        network = partial(_predict_coefficients, predictor)
        spread = None if math.isnan(predictor.image_noise) else partial(predict_spread, predictor)
        made.append(Renderer(run_name("learned", run), model, network, spread=spread))
        made.append(Renderer(run_name("learned_extended", run), model, network, effects))
    made.append(Renderer("global", model, _defaults(model)))
    made.append(Renderer("global_extended", model, _defaults(model), effects))
    hapke = get_model(published.model)
    made.append(Renderer("hapke", hapke, Constant(np.array([published.values[p.name] for p in hapke.parameters]))))
    for name in ("kernels", "lunar_lambert"):
        made.append(Renderer(name, get_model(name), _defaults(get_model(name))))
    made.append(Renderer("hapke_fitted", get_model("hapke"), _defaults(get_model("hapke"))))
    return {renderer.name: renderer for renderer in made}


def _predict_coefficients(predictor: Predictor, batch: Batch) -> Tensor:
    return predict(predictor, batch)[0]


def _defaults(model: ReflectanceModel) -> Constant:
    return Constant(np.array([p.default for p in model.parameters]))


def make_rows(renderers: dict[str, Renderer], runs: int, extended: bool, only: Sequence[str] = ()) -> list[Row]:
    """The rows (or those in ``only``), a learned one for each training run."""
    return [
        Row(name, renderers[run_name(source, run)], matching, run)
        for name, source, matching in layout(extended)
        for run in range(runs if source.startswith("learned") else 1)
        if not only or name in only
    ]


def run_name(source: str, run: int) -> str:
    """The renderer of one training run."""
    return f"{source}:{run + 1}" if run else source
