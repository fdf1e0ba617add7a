"""Whether it is the form of the smooth nominal model that is wrong: another model alone explains more than causes do."""

from __future__ import annotations

import dataclasses

from stages.diagnose.looking import Round, misfit
from stages.diagnose.nominal import load_nominal
from stages.diagnose.state import OF_THE_FORM, RICH, Cause, Saved, Search

SIMPLE = "M2"
PHYSICAL = "hapke"
LUNAR = (RICH, PHYSICAL)  # forms that real ground may have
AS_GOOD = 1.1  # times what the rich one leaves: a model whose coefficients mean something is taken, and leaves more to be told
GROSS = 0.1  # residual over mean brightness, from which a form is questioned before anything else ...
HALVED = 0.5  # ... and dropped if another one leaves so little of it
BEYOND = 0.03  # of what these causes explain: so much a true one may leave that a rich form does not ...
CHANCE = 0.004  # ... or of the sum of squares, which the rich form's further coefficients gain by themselves


def first_form(state: Search) -> str | None:
    """The form that halves a residual that is large before anything is named, if one does. The state stays as it was.

    M2 leaves a sixth of the brightness of ground that follows Hapke's, McEwen's or Akimov's law, which any cause can lessen.
    """
    mine = state.nominal
    if mine.predictor is not None or mine.model.name in LUNAR:
        return None
    light = sum(float(site.image[site.valid].sum()) for site in state.sites)
    rms = state.residual_rms()
    if not rms > GROSS * abs(light) / sum(int(site.valid.sum()) for site in state.sites):
        return None
    now, best, least = state.save(), None, HALVED * rms
    for name in LUNAR:
        state.load(now)
        state.nominal = load_nominal(None, name, state.units)
        state.fit(start=True)
        left = state.residual_rms()
        if left < least:
            best, least = name, left
    state.nominal = mine
    state.load(now)
    return best


def simpler_form(state: Search, before: Saved, seen: Round, cause: Cause) -> str | None:
    """The simple model, if in the place of a curved one it leaves less than that with the cause just named; or None.

    A checkpoint is judged as it is. The state stays as it was.
    """
    mine = state.nominal
    if mine.predictor is not None or mine.model.linear or cause.effect.name not in OF_THE_FORM:
        return None
    now, least = state.save(), misfit(state, seen.works)
    left = _left(state, before, seen, SIMPLE)
    state.load(now)
    return SIMPLE if left < least else None


def richer_form(state: Search, seen: Round, unexplained: bool) -> str | None:
    """A model that leaves less in the place of the nominal one and all causes that look like a wrong form; or None.

    unexplained : much is left that nothing explains. The state stays as it was.
    """
    suspects = [c for c in state.causes if c.effect.name in OF_THE_FORM]
    mine = state.nominal
    if mine.predictor is not None or mine.model.name == RICH or not (suspects or unexplained):
        return None
    now, least = state.save(), misfit(state, seen.works)
    others = dataclasses.replace(now, causes=[c for c in now.causes if all(c[0] is not s for s in suspects)])
    left = _left(state, others, seen, RICH)
    margin = CHANCE * least
    if len(suspects) == 1 and left < least - margin:  # two of them may well be what a third form looks like
        explained = _left(state, others, seen, state.nominal.model.name) - least
        margin = max(margin, BEYOND * explained)
    best = RICH if left < least - margin else None
    if (
        best
        and mine.model.name != PHYSICAL
        and _left(state, others, seen, PHYSICAL) < min(AS_GOOD * left, least - margin)
    ):
        best = PHYSICAL
    state.load(now)
    return best


def _left(state: Search, start: Saved, seen: Round, name: str) -> float:
    """Sum of squares that a model of this name leaves, fitted in the nominal one's place to the state as it was at ``start``."""
    mine = state.nominal
    state.load(start)
    if name != mine.model.name:
        state.nominal = load_nominal(None, name, state.units)
    state.fit(start=name != mine.model.name)
    left = misfit(state, seen.works)
    state.nominal = mine
    return left


__all__ = ["first_form", "richer_form", "simpler_form"]
