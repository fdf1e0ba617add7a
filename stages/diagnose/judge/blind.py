"""What these data cannot show: an effect of a size worth knowing is added to the residuals, and decided on like any other claim."""

from __future__ import annotations

import math
from collections.abc import Container

import numpy as np

from stages.common.arrays import Floats
from stages.diagnose.judge.claim import Claim, decide
from stages.diagnose.judge.refine import error_of_rms
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.columns import Guise
from stages.diagnose.likelihood.weigh import Found, family_wise, weigh
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.sources.search import Outcome, held_out, rivals_of
from stages.effects import effect_names, get_effect


def blind_effects(state: State, out: Outcome, shown: Container[str]) -> list[str]:
    """Effects that would get no name at a size worth knowing; shown : those that are named, or that their own source would show"""
    return [n for n in effect_names() if n not in shown and _blind(state, out, n)]


def _blind(state: State, out: Outcome, name: str) -> bool:
    cls = get_effect(name)
    if cls.judged_apart:
        return False
    if cls.edges_tell:  # shadows judge it, unless nobody knows how dark they are
        return state.free_gains or all(site.observation.sun_horizon is None for site in state.sites)
    if name not in out.best:
        return True
    whole, guise = out.view.whole, out.best[name].guise
    every = [_per_frame(whole, guise, state.seed)] if guise.per_frame else _each(guise)
    return any(decide(_injected(state, out, guise, amount)) is not None for amount in every)


def _each(guise: Guise) -> list[Floats]:
    """Amounts of a guise's columns: of each coordinate alone the size worth knowing, with the sign of its trial."""
    cls = get_effect(guise.effect)
    out = []
    for k, column in enumerate(guise.trial.columns):
        ((name, at),) = column.items()
        amount = np.zeros(len(guise.columns))
        size = abs(at - cls.null()[name])
        amount[k] = (cls.strong.get(name, 0.0) or size) / size
        out.append(amount)
    return out


def _per_frame(whole: Whole, guise: Guise, seed: int) -> Floats:
    """Values of all frames, drawn with the rms worth knowing."""
    drawn = np.random.default_rng(seed).standard_normal(len(whole.places(guise)))
    return drawn / max(math.sqrt(float((drawn**2).mean())), 1e-9)


def _injected(state: State, out: Outcome, guise: Guise, amount: Floats) -> Claim:
    """The claim of the effect where so much of it is added to the residuals."""
    cls, places = get_effect(guise.effect), out.view.whole.places(guise)
    whole = out.view.whole.with_added(places, amount)
    found = _weighed(whole, guise, out)
    p = found.p
    gains, units = held_out(whole, found)
    others = {n: _weighed(whole, out.best[n].guise, out) for n in out.open_rivals(guise.effect)}
    rivals = rivals_of(whole, found, others, {})
    if guise.per_frame:
        size = cls.size(cls.strong)
        covariance = np.diag(found.error**2)
        rms = math.sqrt(float((found.amount**2 + found.error**2).mean()))
        error = error_of_rms(found.amount, covariance, rms, len(places))
        sizes = dict.fromkeys([*cls.tolerance, "rms"], (rms * size, error * size))
        return Claim(
            cls({}, state.data), sizes, gains, units, rms / max(error, 1e-30), 1, p, rivals=rivals, values=found.values
        )
    moves, errors, covariance = whole.errors(places, whole.exclude(guise))
    wider = max(float((errors**2 / np.maximum(covariance.diagonal(), 1e-30)).mean()), 1.0)
    away = math.sqrt(max(float(moves @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ moves), 0.0) / wider)
    values, known = {**cls.null(), **guise.trial.fixed}, {}
    for move, error, column in zip(moves, errors, guise.trial.columns, strict=True):
        for name, at in column.items():
            away_from_nothing = at - cls.null()[name]
            values[name] = cls.null()[name] + float(move) * away_from_nothing
            known[name] = math.hypot(
                float(error) * away_from_nothing, min(state.law, 1.0) * cls.law_error.get(name, 0.0)
            )
    sizes = {k: (abs(v - cls.null().get(k, 0.0)), e) for k, (v, e) in cls.report(values, known).items()}
    return Claim(cls(values, state.data), sizes, gains, units, away, len(moves), p, rivals=rivals, values=found.values)


def _weighed(whole: Whole, guise: Guise, out: Outcome) -> Found:
    """The evidence for a guise, with its family-wise p."""
    found, _ = weigh(whole, guise)
    found.p = family_wise(found.surprise, out.largest)
    return found


__all__ = ["blind_effects"]
