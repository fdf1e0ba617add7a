"""The diagnosis as data: verdict, causes, held-out gain, and the extended model for other stages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from schemas import DIAGNOSIS, ArtefactWriter
from stages.diagnose.images import spread
from stages.diagnose.nominal import Nominal, _scale, lit_mask
from stages.diagnose.state import Cause
from stages.effects import Effect, get_effect
from stages.effects.column_pattern import ColumnPattern

VERDICTS = ("named", "nothing_significant", "unexplained", "cannot_tell")
# effect -> its variable in diagnosis.h5 and what the second dimension is
TABLES = {
    "misregistration": ("image_shift_px", "axis"),
    "line_jitter": ("line_jitter_px", "mode"),
    "image_gain": ("image_gain", None),
    "albedo_map": ("site_albedo", "term"),
}
RESAMPLES = 1000


@dataclass
class HeldOut:
    """Mean squared errors on pairs that no estimate saw; the interval is a bootstrap over ground tiles."""

    pairs: int = 0
    nominal: float = math.nan
    extended: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def gain(self) -> float:
        return 100 * (1 - self.extended / self.nominal) if self.nominal > 0 else math.nan

    def to_json(self) -> dict[str, Any]:
        return {
            "pairs": self.pairs,
            "mse_nominal": _number(self.nominal),
            "mse_extended": _number(self.extended),
            "gain_percent": _number(self.gain),
            "gain_percent_low": _number(self.low),
            "gain_percent_high": _number(self.high),
        }


def held_out(
    sites,
    tiles,
    models: tuple[Nominal, Nominal],
    effects: tuple[Sequence[Effect], Sequence[Effect]],
    dn: bool,
    seed: int,
) -> HeldOut:
    """Score two models, each with its effects, on sites that were kept away; in dn both get a gain and offset per pair."""
    sums: list[tuple[int, float, float, int]] = []
    pairs = 0
    for site, tile in zip(sites, tiles, strict=True):
        squares = []
        for model, chosen in zip(models, effects, strict=True):
            chain = model.chain(site, chosen)
            predicted = chain.predict()
            mask = lit_mask(models[0].chain(site, []))
            raw = site.image * site.gain[:, None, None] + site.offset[:, None, None]
            if dn:
                _scale(site, raw, predicted, mask)
            scale = site.gain[:, None, None].abs()
            error = (site.image - predicted).double() * (scale / scale.mean() if dn else 1.0)
            squares.append([float(e[m].square().sum()) for e, m in zip(error, mask, strict=True)])
        counts = [int(m.sum()) for m in mask]
        pairs += site.count
        sums += [(int(t), a, b, n) for t, a, b, n in zip(tile, *squares, counts, strict=True)]
    if not sums or sum(s[3] for s in sums) == 0:
        return HeldOut()
    labels = np.array([s[0] for s in sums])
    if len(np.unique(labels)) < 4:  # few tiles: the images of a tile are the units
        labels = np.arange(len(sums))
    values = np.array([s[1:] for s in sums])
    groups = np.array([values[labels == k].sum(0) for k in np.unique(labels)])
    total = groups.sum(0)
    draw = np.random.default_rng(seed).integers(len(groups), size=(RESAMPLES, len(groups)))
    again = groups[draw].sum(1)
    gains = 100 * (1 - again[:, 1] / np.maximum(again[:, 0], 1e-30))
    low, high = np.percentile(gains, [2.5, 97.5])
    return HeldOut(pairs, total[0] / total[2], total[1] / total[2], float(low), float(high))


@dataclass
class Answer:
    """Everything that the report says."""

    verdict: str
    causes: list[Cause] = field(default_factory=list)
    closest: list[str] = field(default_factory=list)
    unexplained_fraction: float = 0.0
    blind: list[str] = field(default_factory=list)
    held_out: HeldOut = field(default_factory=HeldOut)
    pairs: int = 0
    sites: int = 0
    images: int = 0
    note: str = ""
    form: str = ""  # of the nominal model, where that asked for was replaced
    config: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {
            "verdict": self.verdict,
            "causes": [cause_json(c) for c in self.causes],
            "closest": self.closest,
            "unexplained_fraction": _number(self.unexplained_fraction),
            "blind": self.blind,
            "held_out": self.held_out.to_json(),
            "data": {"pairs": self.pairs, "sites": self.sites, "images": self.images},
            "note": self.note,
            "nominal": self.form or None,
            "sentence": self.sentence(),
            "config": self.config,
        }

    def sentence(self) -> str:
        """The diagnosis in one plain sentence, after one on the nominal model where that was replaced."""
        if not self.form:
            return self._finding()
        asked = self.config.get("model", "the model")
        return (
            f"The reflectance does not have the form of {asked}: {self.form} alone explains more than {asked} does with any cause, "
            f"and was fitted in its place. {self._finding()}"
        )

    def _finding(self) -> str:
        if self.note:
            return self.note[0].upper() + self.note[1:] + ("" if self.note.endswith(".") else ".")
        if self.verdict == "named":
            parts = [f"{get_effect(c.effect.name).title} ({describe(parameters(c))})" for c in self.causes]
            gain = self.held_out.gain
            worth = f"; it lowers the squared error of unseen pairs by {gain:.1f} %" if math.isfinite(gain) else ""
            return f"The simulation lacks {' and '.join(parts)}{worth}."
        if self.verdict == "unexplained":
            near = f"; the closest candidate is {self.closest[0]}" if self.closest else ""
            return f"The residual holds structure that nothing in the catalogue explains{near}."
        if self.verdict == "cannot_tell":
            return f"Nothing significant was found, but these data could not show: {', '.join(self.blind)}."
        return "Nothing in the catalogue explains a significant part of the residual, and no structure is left over."


def parameters(cause: Cause) -> dict[str, dict[str, Any]]:
    """Reported parameters with errors and units."""
    effect = cause.effect
    cls = type(effect)
    units = {p.name: p.unit for p in cls.parameters}
    if cls.scope == "scene" and cls.name != "column_pattern":
        held = {k: float(v) for k, v in effect.values.items()}
        errors = {k: math.hypot(e, cause.along.get(k, 0.0)) for k, e in cause.errors.items()}
        found = cls.report(held, errors)
    else:
        name = cls.parameters[0].name
        if cls.name == "column_pattern":
            values = [float(v) for v in effect.values.values()]
            size = math.sqrt(sum(v * v for v in values))
            error = math.sqrt(sum((v * cause.errors.get(k, 0)) ** 2 for k, v in effect.values.items())) / max(
                size, 1e-12
            )
        else:
            table = torch.stack([torch.as_tensor(v, dtype=torch.float64) for v in effect.values.values()], 1)
            evidence = cause.image_evidence
            size, error = spread(table, evidence), evidence.rms_error if evidence else 0.0
        found = {name: (size, error)}
    return {k: {"value": _number(v), "error": _number(e), "unit": units[k]} for k, (v, e) in found.items()}


def describe(found: dict[str, dict[str, Any]]) -> str:
    """Reported parameters as 'error_deg = 0.31 +- 0.02 degree'."""
    return ", ".join(
        f"{k} = {p['value']:.3g} +- {p['error']:.1g}{'' if p['unit'] == '1' else ' ' + p['unit']}"
        for k, p in found.items()
    )


def cause_json(cause: Cause) -> dict[str, Any]:
    return {
        "effect": cause.effect.name,
        "parameters": parameters(cause),
        "p_family_wise": cause.p,
        "gain_nats": cause.gain,
        "gain_error": cause.gain_error,
        "residual_rms_before": _number(cause.rms_before),
        "residual_rms_after": _number(cause.rms_after),
        "size_over_noise": cause.fid,
        "group": cause.group,
        "to_separate": get_effect(cause.effect.name).separate,
    }


def write_diagnosis(
    path: Path, answer: Answer, image_ids: Sequence[str], inputs: Sequence[Path], overwrite: bool
) -> None:
    """diagnosis.h5: the report, and the extended model that `load_extension` reads."""
    import json

    entries, tables = [], {}
    sizes = {"frame": len(image_ids)}
    for cause in answer.causes:
        effect = cause.effect
        entry: dict[str, Any] = {"effect": effect.name, "survey": effect.survey.to_json(), "values": {}}
        if effect.name in TABLES:
            variable, second = TABLES[effect.name]
            data = torch.stack([torch.as_tensor(v) for v in effect.values.values()], 1).numpy()
            tables[variable] = data if second else data[:, 0]
            entry["tables"] = {k: {"variable": variable, "column": j} for j, k in enumerate(effect.values)}
            if second:
                sizes[second] = data.shape[1]
            if effect.scope == "site":
                sizes["site"] = len(data)
        else:
            entry["values"] = {k: float(v) + effect.in_simulation.get(k, 0.0) for k, v in effect.values.items()}
        if isinstance(effect, ColumnPattern):
            tables["column_response"] = effect.response(256)
            sizes["column"] = 256
        entries.append(entry)
    attributes = {"report": json.dumps(answer.to_json()), "extension": json.dumps(entries)}
    with ArtefactWriter(
        path, DIAGNOSIS, sizes, config=answer.config, inputs=inputs, attributes=attributes, overwrite=overwrite
    ) as writer:
        writer.write("image_id", image_ids)
        for name, data in tables.items():
            writer.write(name, data)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
