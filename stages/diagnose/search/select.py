"""Forward selection: the effect that gains most on held-out ground is named, if shams seldom do as well and it does not come out ordinary."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

from stages.diagnose.likelihood.found import Found, interval
from stages.diagnose.likelihood.weigh import weigh_all
from stages.diagnose.search.doubts import (
    ODD,
    ORDINARY,
    beyond_bounds,
    contradicted,
    doubt,
    doubt_all,
    doubt_any,
    ordinary,
)
from stages.diagnose.search.gains import secant_gains
from stages.diagnose.search.refine import as_effect, errors_over_images, refine, settle, start_nearer
from stages.diagnose.search.rivals import another_law, choose, judge, may_be_another, shows_in_shade
from stages.diagnose.search.state import Cause, State, View
from stages.diagnose.search.tested import hidden_look
from stages.diagnose.settings import DISCOVERY, FAINT, NOTABLE, TRIED, TRIES
from stages.effects import get_effect


@dataclass
class Outcome:
    """The last look, every effect's evidence there, and what had strong evidence and was not named (name -> nats, why)."""

    view: View | None = None
    best: dict[str, Found] = field(default_factory=dict)
    rejected: dict[str, tuple[float, str]] = field(default_factory=dict)
    sure: bool = False  # whether something stands out that no plausible effect explains


def search(state: State, most: int) -> Outcome:
    """Name causes until no candidate is left."""
    out = Outcome()
    refused: dict[str, str] = {}  # effect -> why
    view: View | None = None
    state.choose_law()
    while True:
        # the data look as before where nothing was named
        view = state.without_impossible(view, state.open_names()) if view else state.look(state.open_names())
        if refused and not state.named and state.law_is_another(view, refused):  # before, it was not
            rendered = {c.effect.name for c in state.causes}
            # of the others nothing was judged beside this law
            refused = {n: why for n, why in refused.items() if n in rendered or get_effect(n).of_law}
            state.impossible.clear()
            view = None
            continue
        best, _ = weigh_all(view.whole)
        out.rejected = {k: v for k, v in out.rejected.items() if k in refused}
        out.view, out.best = view, best
        # values per image of a cause are weighed as well: what is left of them is no further cause
        done = {*refused, *(c.effect.name for c in state.causes)}
        strong = [f for f in best.values() if f.p <= DISCOVERY and f.effect not in done]
        strong.sort(key=lambda f: -f.surprise)
        tried: list[Found] = []
        for found in strong:
            judge(view.whole, found)
            if why := another_law(view.whole, found):
                out.rejected[found.effect] = (found.gain, why)
            else:
                tried.append(found)
            if len(tried) == TRIED:
                break
        tried.sort(key=lambda f: -f.gain)
        faint = FAINT**2 / 2 * float(view.whole.gram[0, 0])
        sure = [f for f in tried if f.gain_interval()[0] > 0 and (f.gain > faint or shows_in_shade(view.whole, f))]
        out.rejected |= {f.effect: (f.gain, _why_not_sure(f, faint)) for f in tried if f not in sure}
        if len(state.named) >= most:
            break
        taken = strange = False
        for _ in range(TRIES):
            if not sure or taken or strange:
                break
            chosen, group = choose(sure, tried)
            sure = [f for f in sure if f is not chosen]
            before = list(state.causes)
            why = may_be_another(view.whole, chosen, best, refused) or take(state, view, chosen, group)
            taken, strange = not why, why.startswith(ODD)
            for gone in [c for c in before if c not in state.causes]:
                refused[gone.effect.name] = f"beside {chosen.effect} it is no cause any more"
                out.rejected[gone.effect.name] = (gone.found.gain, refused[gone.effect.name])
            if taken:
                state.say(f"{chosen.effect} gains {chosen.gain:.0f} nats on held-out ground")
                continue
            state.say(f"{chosen.effect} is not taken: {why}")
            refused[chosen.effect] = why
            taken = any(c.effect.name == chosen.effect for c in state.causes)  # rendered, and not named
            out.rejected[chosen.effect] = (chosen.gain, why)
            if strange:  # the others were judged beside amounts of it that nothing has
                out.sure |= chosen.gain > NOTABLE * float(view.whole.gram[0, 0])
                state.impossible.add(chosen.effect)
        if not (taken or strange):
            odd = {f.effect for f in tried if not f.guise.per_frame and beyond_bounds(f)} - state.impossible
            if not odd:
                break
            state.impossible |= odd  # what it gains may not be sure, and it hides others all the same
        if taken:
            view = None
    settle(state, view)
    out.rejected |= doubt_all(state, view)
    for cause in state.named:
        out.rejected.pop(cause.effect.name, None)
    return out


def _why_not_sure(found: Found, faint: float) -> str:
    low, high = found.gain_interval()
    if low > 0:
        return f"it gains {found.gain:.0f} nats, and less than {faint:.0f} is ordinary in so many pixels"
    return f"on ground that it was not fitted to it gains {found.gain:.0f} nats ({low:.0f} .. {high:.0f}), which may be nothing"


def take(state: State, view: View, found: Found, group: list[str]) -> str:
    """Put the effect into the model and fit everything again; '' if it stays, or why it does not (all is as before then)."""
    cls = get_effect(found.effect)
    if cls.linear and not found.guise.per_frame and beyond_bounds(found):
        return ODD
    first = as_effect(found, state.data, state.frames, view.whole)
    if cls.scope == "scene" and not cls.plausible({k: float(v) for k, v in first.values.items()}, state.data):
        return ODD
    if why := ordinary(first):
        return why
    tested = hidden_look(state, view)
    vector, causes = state.nominal.vector, list(state.causes)
    saved = [(c, c.copy()) for c in causes]
    cause = Cause(first, found, group=group)
    state.causes.append(cause)
    start_nearer(state, view, cause)
    look, why = _fit_beside(state, view, cause)
    if not why:
        gains, sizes, total, test_gains = secant_gains(state, cause, look, tested)
        low, high = interval(gains, sizes)
        cause.gain_percent, cause.gain_low, cause.gain_high = (200 * x / total for x in (float(gains.sum()), low, high))
        cause.found = dataclasses.replace(cause.found, gains=gains, sizes=sizes)
        if low <= 0:
            why = f"fitted with everything else it gains {gains.sum():.0f} nats on held-out ground ({low:.0f} .. {high:.0f}), which may be nothing"
        why = why or contradicted(test_gains)
    ordinary_alone = why.endswith(ORDINARY) and why == doubt(state, cause)
    cause.ordinary = ordinary_alone and cls.scope == "scene" and not (cls.of_law or cls.lights_shadows)
    if cause.ordinary:  # a first-order column of a blur is wrong by more than the noise
        return why
    if why:
        state.open[cause.effect.name] = cause.worst_error
        state.causes[:] = causes
        for c, before in saved:
            vars(c).update(vars(before))
        state.nominal.vector = vector
        state.fit()
    return why


def _fit_beside(state: State, view: View, cause: Cause) -> tuple[View, str]:
    """Fit everything with the new cause; why it, or another beside it, cannot be one, or ''.

    One that is nothing beside the new one makes way for it: the new one is something beside either. Values per frame, which mimic what
    one value for all does, drive none out, nor does what is in no catalogue.
    """
    while True:
        look = refine(state, view)
        why, other = doubt_any(state, cause)
        if not why:
            errors_over_images(state, look)
            why, other = doubt_any(state, cause)
        if other is None or cause.found.guise.per_frame or not cause.effect.listed or ODD in why:
            return look, why
        state.causes.remove(other)


__all__ = ["Outcome", "search"]
