"""Causes of the search as they are reported."""

from __future__ import annotations

import math

from stages.diagnose.judge.state import Cause, State
from stages.diagnose.likelihood.intervals import interval
from stages.diagnose.result.answer import Named
from stages.diagnose.sources.search import Outcome
from stages.effects import get_effect


def by_search(state: State, outcome: Outcome) -> tuple[list[Named], list[Named]]:
    """Causes with a name, and those of a size that any data set has."""
    named = [_reported(state, c, True) for c in state.named]
    ordinary = [c for c in [*state.causes, *outcome.ordinary.values()] if c not in state.named]
    return named, [_reported(state, c, False) for c in ordinary if c.effect.listed]


def _reported(state: State, cause: Cause, beyond: bool) -> Named:
    """With errors and units; beyond : what is ordinary is part of what was found, and of the errors"""
    cls = type(cause.effect)
    units = {p.name: p.unit for p in cls.parameters}
    found = cause.reported(state.law)
    least = {"rms": max(cls.tolerance.values(), default=0.0)} if cls.scope != "scene" else cls.tolerance
    if beyond:
        found = {k: (v, math.hypot(e, least.get(k, 0.0))) for k, (v, e) in found.items()}
    low, high = interval(cause.gains, cause.units)
    total = cause.total if cause.total > 0 else math.nan
    percent = tuple(200 * x / total for x in (float(cause.gains.sum()), low, high))
    return Named(
        cause.effect,
        {k: (v, e, units[k]) for k, (v, e) in found.items()},
        cause.found.p,
        float(cause.gains.sum()),
        (high - low) / 4,
        cause.rms_before,
        cause.rms_after,
        percent,  # type: ignore[arg-type]
        [n for n in cause.group if get_effect(n).listed],
    )


def in_words(state: State) -> dict[str, float]:
    """What is in the model and stands in no catalogue, in words, and the share of the squares that it takes away; it is no cause from here on."""
    out = {}
    for cause in [c for c in state.named if not c.effect.listed]:
        cause.ordinary = True
        ((value, error), *_) = cause.reported(state.law).values()
        unit = type(cause.effect).parameters[0].unit
        words = f"{cause.effect.title} ({value:.2g} +- {error:.1g}{'' if unit == '1' else ' ' + unit})"
        out[words] = 2 * float(cause.gains.sum()) / cause.total
    return out


__all__ = ["by_search", "in_words"]
