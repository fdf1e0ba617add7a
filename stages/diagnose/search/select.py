"""Forward selection: the effect that gains most on held-out ground is named, if shams seldom do as well and it does not come out ordinary."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from stages.diagnose.likelihood.found import Found, beyond_bounds, interval
from stages.diagnose.likelihood.weigh import weigh_all
from stages.diagnose.search.doubts import (
    ODD,
    ORDINARY,
    doubt,
    doubt_all,
    doubt_any,
    impossible,
    ordinary,
    surely_ordinary,
)
from stages.diagnose.search.gains import secant_gains
from stages.diagnose.search.refine import along, as_effect, errors_over_images, refine, settle, start_nearer
from stages.diagnose.search.rivals import another_law, choose, judge, may_be_another
from stages.diagnose.search.state import Cause, State, View
from stages.diagnose.settings import DISCOVERY, NOTABLE, SHAMS, TRIED, TRIES
from stages.effects import Effect, get_effect

PART_OF_A_LAW = "another law of the ground surely gains beside it, of which this is only a part"
TAKEN, STRANGE, LIKELY = "rendered", "nothing real has its values", "to be fitted"  # how a look at the candidates ends


@dataclass
class Outcome:
    """The last look, every effect's evidence there, and what had strong evidence and was not named (name -> nats, why).

    beside : what is fitted along, as it was rendered beside the causes
    """

    view: View | None = None
    beside: View | None = None
    best: dict[str, Found] = field(default_factory=dict)
    rejected: dict[str, tuple[float, str]] = field(default_factory=dict)
    sure: bool = False  # whether something stands out that no plausible effect explains


@dataclass
class Weighed:
    """Every effect's evidence in one look, the candidates whose gains on held-out ground were computed, those that gain for sure, and why others do not."""

    best: dict[str, Found]
    tried: list[Found]
    sure: list[Found]
    rejected: dict[str, tuple[float, str]]


def search(state: State, most: int) -> Outcome:
    """Name causes until no candidate is left."""
    out = Outcome()
    refused: dict[str, str] = {}  # effect -> why
    view = state.look(state.open_names())
    if state.law_is_another(view):  # before anything else is looked at: what that takes is soon rendered
        view = state.look(state.open_names())
    fresh = True  # whether all of it was rendered beside the causes as they are
    while True:
        law = [c for c in state.named if c.effect.of_law]
        if (law or (refused and not state.named)) and state.law_is_another(view, refused):  # before, it was not
            for cause in law:
                out.rejected[cause.effect.name] = cause.found.gain, PART_OF_A_LAW
            rendered = {c.effect.name for c in state.causes}
            # of the others nothing was judged beside this law
            refused = {n: why for n, why in refused.items() if n in rendered or get_effect(n).of_law}
            refused |= {c.effect.name: PART_OF_A_LAW for c in law}
            out.sure = False
            state.impossible.clear()
            view, fresh = state.look(state.open_names()), True
            continue
        weighed = _weigh(state, view, refused)
        out.rejected = {k: v for k, v in out.rejected.items() if k in refused} | weighed.rejected
        out.view, out.best = view, weighed.best
        if len(state.named) >= most:
            break
        before = list(state.causes)
        end = _take_one(state, view, weighed, refused, out, fresh)
        if end == LIKELY:
            view, fresh = state.look(state.open_names()), True
            continue
        if end == TAKEN:
            # what was rendered without the new cause shows as well whether anything is left; of one that made way nothing was
            fresh = not all(c in state.causes for c in before)
            names = state.open_names()
            view = state.look(names) if fresh else state.again(view, names, shams=SHAMS, candidates=None)
            continue
        if end != STRANGE:
            odd = _hiding(weighed) - state.impossible
            if not odd:
                break
            state.impossible |= odd
        view = state.without_impossible(view, state.open_names())  # the data look as before
    out.beside = view if fresh or not state.named else state.look(along(state, view), 0, ())
    settle(state, out.beside)
    out.rejected |= doubt_all(state, out.beside)
    for cause in state.named:
        out.rejected.pop(cause.effect.name, None)
    return out


def _weigh(state: State, view: View, refused: Mapping[str, str]) -> Weighed:
    """Which effects have evidence, and of these, which surely gain on held-out ground."""
    best, _ = weigh_all(view.whole)
    # values per image of a cause are weighed as well: what is left of them is no further cause
    done = {*refused, *(c.effect.name for c in state.causes)}
    done |= {n for n in best if get_effect(n).edges_tell}
    strong = [f for f in best.values() if f.p <= DISCOVERY and f.effect not in done]
    strong.sort(key=lambda f: -f.surprise)
    tried: list[Found] = []
    rejected: dict[str, tuple[float, str]] = {}
    for found in strong:
        judge(view.whole, found)
        if why := another_law(view.whole, found):
            rejected[found.effect] = (found.gain, why)
        else:
            tried.append(found)
        if len(tried) == TRIED:
            break
    tried.sort(key=lambda f: -f.gain)
    sure = [f for f in tried if f.gain_interval()[0] > 0]
    rejected |= {f.effect: (f.gain, no_sure_gain(f.gain, *f.gain_interval())) for f in tried if f not in sure}
    return Weighed(best, tried, sure, rejected)


def _take_one(state: State, view: View, weighed: Weighed, refused: dict[str, str], out: Outcome, fresh: bool) -> str:
    """Try the candidates that gain for sure until one is rendered; how that ended.

    fresh : whether the look was rendered beside all causes, or has to be before a candidate is fitted that nothing speaks against
    """
    sure = weighed.sure
    for _ in range(TRIES):
        if not sure:
            break
        chosen, group = choose(sure, weighed.tried)
        sure = [f for f in sure if f is not chosen]
        before = list(state.named)
        why = may_be_another(view.whole, chosen, weighed.best, refused) or unlikely(state, view, chosen)
        if not why and not fresh:
            return LIKELY
        why = why or take(state, view, chosen, group)
        for gone in [c for c in before if c not in state.named]:
            refused[gone.effect.name] = f"no longer needed once {chosen.effect} is in the model"
            out.rejected[gone.effect.name] = (gone.found.gain, refused[gone.effect.name])
        if not why:
            state.say(f"{chosen.effect} gains {chosen.gain:.0f} nats on held-out ground")
            return TAKEN
        state.say(f"{chosen.effect} is not taken: {why}")
        refused[chosen.effect] = why
        out.rejected[chosen.effect] = (chosen.gain, why)
        if why.startswith(ODD):  # the others were judged beside amounts of it that nothing has
            out.sure |= chosen.gain > NOTABLE * float(view.whole.gram[0, 0])
            state.impossible.add(chosen.effect)
            return STRANGE
        if any(c.effect.name == chosen.effect for c in state.causes):  # rendered, and not named
            return TAKEN
    return ""


def _hiding(weighed: Weighed) -> set[str]:
    """Effects of which nothing real has as much as fits best beside the others, and that hide what they stand for. What they gain need not be sure, and
    they may be refused: a blur below nothing comes to nothing once it is fitted within its bounds, and is all that a DEM which is too smooth looks like.
    """
    return {f.effect for f in weighed.best.values() if not f.guise.per_frame and beyond_bounds(f)}


def no_sure_gain(gain: float, low: float, high: float) -> str:
    """The reason that a gain on held-out ground may be chance."""
    within = (
        f"95 %: {low:.0f} .. {high:.0f}"
        if math.isfinite(low)
        else "too few pieces of ground tell of it for an interval"
    )
    return f"no sure gain on held-out ground ({gain:.0f} nats; {within})"


def unlikely(state: State, view: View, found: Found) -> str:
    """Why the effect is none already at the first estimate of its values, or ''."""
    cls = get_effect(found.effect)
    beyond = not found.guise.per_frame and beyond_bounds(found)
    first = as_effect(found, state.data, state.frames, view.whole)
    if beyond and cls.linear:
        return impossible(first)
    if cls.scope == "scene" and not cls.plausible({k: float(v) for k, v in first.values.items()}, state.data):
        return impossible(first)
    if _is_rendered(cls) and found.gain > NOTABLE * float(view.whole.gram[0, 0]):
        return ""  # however ordinary: what is left is no more than noise beside it, and the others are judged in that
    return "" if beyond else ordinary(first)  # a bound is no estimate of its size


def _is_rendered(cls: type[Effect]) -> bool:
    """Whether an ordinary amount of the effect is rendered to judge the others beside it: a first-order column of a blur is wrong by more than the noise."""
    return cls.scope == "scene" and not (cls.of_law or cls.lights_shadows)


def take(state: State, view: View, found: Found, group: list[str]) -> str:
    """Put the effect into the model and fit everything again; '' if it stays, or why it does not (all is as before then)."""
    cls = get_effect(found.effect)
    first = as_effect(found, state.data, state.frames, view.whole)
    vector, causes, impossible = state.nominal.vector, list(state.causes), set(state.impossible)
    saved = [(c, c.copy()) for c in causes]
    cause = Cause(first, found, group=group)
    state.causes.append(cause)
    start_nearer(state, view, cause)
    look, why = _fit_beside(state, view, cause)
    if not why:
        gains, sizes, total = secant_gains(state, cause, look)
        low, high = interval(gains, sizes)
        cause.gain_percent, cause.gain_low, cause.gain_high = (200 * x / total for x in (float(gains.sum()), low, high))
        cause.found = dataclasses.replace(cause.found, gains=gains, sizes=sizes)
        if low <= 0:
            why = f"fitted together with all other causes, {no_sure_gain(float(gains.sum()), low, high)}"
    ordinary_alone = why.startswith(ORDINARY) and why == doubt(state, cause)
    cause.ordinary = ordinary_alone and _is_rendered(cls)
    if cause.ordinary:
        return why
    if why:
        state.open[cause.effect.name] = cause.worst_error
        state.causes[:], state.impossible = causes, impossible
        for c, before in saved:
            vars(c).update(vars(before))
        state.nominal.vector = vector
        state.fit()
    return why


def _fit_beside(state: State, view: View, cause: Cause) -> tuple[View, str]:
    """Fit everything with the new cause; why it, or another beside it, cannot be one, or ''.

    One that is nothing beside the new one makes way for it: the new one is something beside either. Values per frame, which mimic what
    one value for all does, drive none out. Beside what is in no catalogue it has to be ordinary for sure, and stays as much.
    """
    while True:
        look = refine(state, view)
        why, other = doubt_any(state, cause)
        if not why:
            errors_over_images(state, look)
            why, other = doubt_any(state, cause)
        if other is None or cause.found.guise.per_frame or ODD in why:
            return look, why
        if cause.effect.listed:
            state.causes.remove(other)
        elif _is_rendered(type(other.effect)) and surely_ordinary(other):
            other.ordinary = True
        else:
            return look, why


__all__ = ["Outcome", "search"]
