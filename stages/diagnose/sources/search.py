"""The search over templates: the effect that gains most on other ground is fitted, decided on, and the rest is looked at beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from stages.common.arrays import Floats
from stages.diagnose.judge.claim import Claim, Reason, Refusal, Rival, decide
from stages.diagnose.judge.gains import secant_gains
from stages.diagnose.judge.refine import as_effect, errors_over_images, refine, settle, start_nearer
from stages.diagnose.judge.state import Cause, State, View
from stages.diagnose.likelihood.weigh import Found, beyond_bounds, weigh_all
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.settings import DISCOVERY, NOTABLE, SHAMS, TRIED, TRIES
from stages.effects import Effect, get_effect


@dataclass
class Outcome:
    """The last look, the largest surprises of its shams, every effect's evidence there, and why effects with evidence got no name.

    ordinary : causes of a size that any data set has which are not in the model; strange : whether something that gains much is impossible
    """

    view: View
    largest: Floats
    best: dict[str, Found]
    refused: dict[str, Refusal] = field(default_factory=dict)
    ordinary: dict[str, Cause] = field(default_factory=dict)
    strange: bool = False

    def open_rivals(self, effect: str) -> list[str]:
        """What passes for an effect, without what these data exclude. What the law's departures follow gains in their place, not beside them."""
        excluded = (Reason.IMPOSSIBLE, Reason.ORDINARY, Reason.ANOTHER_LAW)
        names = [n for n in get_effect(effect).confused_with if n in self.best]
        return [n for n in names if n not in self.refused or self.refused[n].reason not in excluded]


def search(state: State, most: int) -> Outcome:
    """Put causes into the model until no candidate is left."""
    view, fresh = state.look(state.open_names()), True
    out = Outcome(view, *weigh_all(view.whole)[::-1])
    closed: set[str] = set()  # effects that are decided on
    while len(state.named) < most:
        candidates = _candidates(state, out, closed)
        if not candidates:
            break
        if not fresh:  # a candidate is fitted beside everything as the causes leave it
            view, fresh = state.look(state.open_names()), True
            out.view = view
            out.best, out.largest = weigh_all(view.whole)
            continue
        taken = False
        for cause in candidates[:TRIES]:
            closed.add(cause.effect.name)
            refusal = take(state, view, cause)
            for gone in _removed(state, out, closed):
                out.refused[gone] = Refusal(Reason.REPLACED, f"after {cause.effect.name}")
            taken = cause in state.causes
            if refusal is None:
                state.say(f"{cause.effect.name} gains {cause.gains.sum():.0f} nats on other ground")
                break
            state.say(f"{cause.effect.name} is not named: {refusal}")
            out.refused[cause.effect.name] = refusal
            out.strange |= _strange(type(cause.effect), refusal, view.whole)
            if taken:
                break
            if refusal.reason is Reason.ORDINARY:
                out.ordinary[cause.effect.name] = cause
        if not taken:
            break
        view, fresh = state.again(view, state.open_names(), shams=SHAMS, candidates=None), False
        out.view = view
        out.best, out.largest = weigh_all(view.whole)
    finish(state, out, fresh)
    return out


def finish(state: State, out: Outcome, fresh: bool = False) -> None:
    """Fit all causes together, take out those that are none then, and look at what is left beside the others.

    fresh : whether the last look was rendered beside these very causes
    """
    beside = out.view
    settle(state, beside)
    while doubted := [(c, why) for c in state.named if (why := state.decide(c, sure=True))]:
        cause, why = doubted[-1]  # what was found last stands on the rest
        out.refused[cause.effect.name] = why
        state.causes.remove(cause)
        fresh = False
        settle(state, beside)
    for cause in state.named:
        out.refused.pop(cause.effect.name, None)
    if state.causes and not fresh:
        out.view = state.look(state.open_names())
        out.best, out.largest = weigh_all(out.view.whole)


def _strange(cls: type[Effect], refusal: Refusal, whole: Whole) -> bool:
    """Whether something that gains much has values that nothing real has; of an effect of the law it is another law."""
    impossible = refusal.reason is Reason.IMPOSSIBLE and not cls.of_law
    return impossible and refusal.gain > NOTABLE * float(whole.gram[0, 0])


def _removed(state: State, out: Outcome, closed: set[str]) -> list[str]:
    """Effects that were named, and are no cause any more."""
    there = {c.effect.name for c in state.causes}
    return [n for n in closed if n not in there and n not in out.refused and n not in out.ordinary]


def _candidates(state: State, out: Outcome, closed: set[str]) -> list[Cause]:
    """Effects that their first estimate does not refuse, those first that gain most. The others go into ``out.refused``."""
    whole = out.view.whole
    done = closed | {c.effect.name for c in state.causes}
    strong = sorted(
        (f for f in out.best.values() if f.p <= DISCOVERY and f.effect not in done), key=lambda f: -f.surprise
    )
    gains = {f.effect: held_out(whole, f) for f in strong[:TRIED]}
    out.refused = {k: v for k, v in out.refused.items() if k in closed}
    every = []
    for found in strong[:TRIED]:
        cause, rivals = _first(state, whole, found, gains, out)
        refusal = decide(_first_claim(state, cause, rivals))
        # beside much that is ordinary the others are judged once it is rendered
        if refusal is None or (
            refusal.reason is Reason.ORDINARY
            and _is_rendered(type(cause.effect))
            and refusal.gain > NOTABLE * float(whole.gram[0, 0])
        ):
            every.append(cause)
        else:
            out.refused[found.effect] = refusal
            out.strange |= _strange(type(cause.effect), refusal, whole)
    return sorted(every, key=lambda c: -float(c.gains.sum()))


def held_out(whole: Whole, found: Found) -> tuple[Floats, Floats]:
    """(U,) nats that an effect gains on each piece of ground that it was not fitted to, and what they go with."""
    # beside gains of every image nothing is left to gain: they know already how bright each is on other ground
    beside = whole.scattered.tolist() if found.levels else []
    places = whole.places(found.guise)
    gains = whole.held_out(places, [*whole.exclude(found.guise), *beside], found.spread)
    # much ground has no shadow, and nothing to gain by light in it
    return gains, whole.power(places, found.amount) if get_effect(found.effect).lights_shadows else whole.sizes


def rivals_of(
    whole: Whole, found: Found, others: Mapping[str, Found], gains: dict[str, tuple[Floats, Floats]]
) -> list[Rival]:
    """What else explains the same: of ``others`` those with evidence, the same on the other side, another law. gains : known ones by name

    What is part of the nuisance as large as it is in these data is none: an effect gains beside it.
    """
    rivals = []
    for name, other in others.items():
        beside = get_effect(name).scatters and not found.levels
        if other.p <= DISCOVERY and not beside:
            if name not in gains:
                gains[name] = held_out(whole, other)
            rivals.append(Rival(name, gains[name][0], other.values))
    if mirrored := whole.mirrored(found.guise):
        same = whole.held_out(whole.places(mirrored), whole.exclude(mirrored))
        rivals.append(Rival("the same on the other side", same, 0))
    if get_effect(found.effect).of_law and len(whole.form_places()):
        rivals.append(Rival("", whole.law_gains(whole.ordinary_places(found.effect)), len(whole.form_places())))
    return rivals


def _first(
    state: State, whole: Whole, found: Found, gains: dict[str, tuple[Floats, Floats]], out: Outcome
) -> tuple[Cause, list[Rival]]:
    """The effect at its first estimate, with its rivals."""
    rivals = rivals_of(whole, found, {n: out.best[n] for n in out.open_rivals(found.effect)}, gains)
    own, units = gains[found.effect]
    effect = as_effect(found, state.data, state.frames, whole)
    cause = Cause(effect, found, own, units)
    cause.group = [found.effect, *(r.name for r in rivals if r.name in type(effect).confused_with)]
    return cause, rivals


def _first_claim(state: State, cause: Cause, rivals: Sequence[Rival]) -> Claim:
    """The claim of a first estimate: its errors are known once it is fitted."""
    found, cls = cause.found, type(cause.effect)
    values = {k: float(v) for k, v in cause.effect.values.items()} if cls.scope == "scene" else {}
    beyond = not found.guise.per_frame and beyond_bounds(found)
    odd = ""
    if values and ((beyond and cls.linear) or not cls.plausible(values, state.data)):
        odd = ", ".join(f"{k} = {v:.3g}" for k, v in values.items()) + (
            f"; expected: {cls.possible}" if cls.possible else ""
        )
    if values:
        errors = {
            n: float(e) * abs(at - cls.null()[n])
            for e, c in zip(found.error, found.guise.trial.columns, strict=True)
            for n, at in c.items()
        }
        sizes = {k: (abs(v - cls.null().get(k, 0.0)), e) for k, (v, e) in cls.report(values, errors).items()}
    else:
        sizes = dict.fromkeys(cls.tolerance, (np.inf, 0.0))
    return Claim(
        cause.effect,
        sizes,
        cause.gains,
        cause.units,
        np.inf,
        1,
        found.p,
        odd=odd,
        values=found.values,
        rivals=rivals,
    )


def _is_rendered(cls: type[Effect]) -> bool:
    """Whether an ordinary amount stays in the model: a first-order column of a blur is wrong by more than the noise."""
    return cls.scope == "scene" and not (cls.of_law or cls.lights_shadows)


def take(state: State, view: View, cause: Cause) -> Refusal | None:
    """Put the effect into the model and fit everything again. Why it gets no name; all is as before then, unless it is ordinary."""
    vector, amounts, scatter = state.nominal.vector, state.nominal.amounts, state.nominal.scatter
    causes, saved = list(state.causes), [(c, c.copy()) for c in state.causes]
    state.causes.append(cause)
    start_nearer(state, view, cause)
    while True:
        look = refine(state, view)
        secant_gains(state, cause, look)
        refusal = state.decide(cause)
        spoilt: list[Cause] = []
        if (
            refusal is None or refusal.reason is Reason.ORDINARY
        ):  # nothing but its scatter over images can refuse it now
            errors_over_images(state, look)
            refusal = state.decide(cause)
            spoilt = [c for c in state.named if c is not cause and state.decide(c, sure=True)]
        # values per image, which can mimic one value for all, drive none out
        if refusal or not spoilt or cause.found.guise.per_frame or not cause.effect.listed:
            break
        state.causes.remove(spoilt[-1])
    if spoilt and not refusal:
        refusal = Refusal(Reason.RIVAL, spoilt[-1].effect.name, float(cause.gains.sum()))
    if refusal and refusal.reason is Reason.ORDINARY and _is_rendered(type(cause.effect)) and not spoilt:
        cause.ordinary = True
        return refusal
    if refusal:
        state.causes[:] = causes
        for c, before in saved:
            vars(c).update(vars(before))
        state.nominal.vector, state.nominal.amounts, state.nominal.scatter = vector, amounts, scatter
        state.fit()
    return refusal


__all__ = ["Outcome", "finish", "held_out", "search"]
