"""The extended model on pairs that nothing was fitted to, and what the data could not have shown."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from stages.diagnose.likelihood.jackknife import gain_interval
from stages.diagnose.model.nominal import Nominal, _scale, lit_mask
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.forms import aligned
from stages.diagnose.result.answer import Answer, HeldOut
from stages.diagnose.search.select import Outcome
from stages.diagnose.search.state import State
from stages.diagnose.settings import SURE
from stages.effects import Effect, effect_names, get_effect


def score(state: State, sites: Sequence[Site], answer: Answer) -> HeldOut:
    """Squared errors of both models on the same pixels; what registration found counts where it is named, else both have it."""
    if not sites or not answer.causes or state.reference is None:
        return HeldOut()
    named = any(c.effect.displaces for c in answer.causes)
    effects = [c.effect for c in answer.causes if not c.effect.displaces or not c.effect.never_named]
    before, after, counts = np.zeros(len(sites)), np.zeros(len(sites)), np.zeros(len(sites))
    pairs = 0
    for k, site in enumerate(sites):
        moved = site.read, site.read_valid
        if state.registration is not None:
            moved = aligned(site.read, site.read_valid, *state.registration.at(state.nominal.chain(site, [])))
        plain = (site.read, site.read_valid) if named else moved
        mask = lit_mask(state.reference.chain(site, [])) & moved[1] & plain[1]
        for into, model, chosen, image in (
            (before, state.reference, [], plain[0]),
            (after, state.nominal, effects, moved[0]),
        ):
            into[k] = _squares(site, model, chosen, image, mask, state.units == "dn")
        counts[k] = float(mask.sum())
        pairs += site.count
    if not counts.sum() > 0:
        return HeldOut()
    _, low, high = gain_interval(before, after)
    total = counts.sum()
    return HeldOut(pairs, len(sites), before.sum() / total, after.sum() / total, low, high)


def _squares(
    site: Site, model: Nominal, effects: Sequence[Effect], image: torch.Tensor, mask: torch.Tensor, free: bool
) -> float:
    site.image = image
    predicted = model.chain(site, effects).predict()
    if free:
        _scale(site, image, predicted, mask)
    scale = site.gain[:, None, None].abs()
    error = (site.image - predicted).double() * (scale / scale.mean() if free else 1.0)
    return float((error * mask).square().sum())


def blind_effects(state: State, outcome: Outcome, named: set[str]) -> list[str]:
    """Effects whose expected error is more than a size worth knowing allows, and which are not seen all the same."""
    out = []
    seen = set(state.open_names())
    for name in effect_names():
        cls = get_effect(name)
        if name in named or (cls.never_named and cls.displaces and state.registration is not None):
            continue
        found = outcome.best.get(name)
        if cls.never_named:
            continue
        if name not in seen or found is None:
            out.append(name)
            continue
        if found.alone >= SURE:
            continue
        whole = outcome.view.whole if outcome.view else None
        assert whole is not None
        error = math.inf
        for guise in whole.plan.guises:
            if guise.effect != name:
                continue
            if guise.per_frame:
                information, _, _, _ = whole.reduce(whole.places(guise))
                error = min(
                    error, float(1 / np.sqrt(max(np.median(information.diagonal()), 1e-12))) / math.sqrt(state.frames)
                )
                continue
            information, _, _, _ = whole.reduce(whole.places(guise), whole.exclude(guise))
            for k, column in enumerate(guise.trial.columns):
                ((coordinate, at),) = column.items()
                size = abs(at - cls.null()[coordinate])
                worth = cls.strong.get(coordinate, 0.0) or size
                error = min(error, size / worth / math.sqrt(max(float(information[k, k]), 1e-30)))
        if SURE * error > 1:
            out.append(name)
    return out


__all__ = ["blind_effects", "score"]
