"""Forward selection: the effect that gains most on held-out ground is named, if shams seldom do as well and it does not come out ordinary."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from stages.common.intervals import student_quantile
from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.found import Found, interval
from stages.diagnose.likelihood.products import Products, Rows, products
from stages.diagnose.likelihood.tails import together
from stages.diagnose.likelihood.weigh import weigh_all
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.model.chain import Chain
from stages.diagnose.search.refine import as_effect, errors_over_images, refine, settle
from stages.diagnose.search.state import Cause, State, View
from stages.diagnose.search.tested import hidden_look, hidden_rows
from stages.diagnose.settings import DISCOVERY, FAINT, NOTABLE, SIMPLER, STILL, SURE, TRIED, TRIES
from stages.effects import Effect, get_effect

ODD = "nothing real has the values that fit best"
ORDINARY = "is ordinary"
UNSURE = "these data are not sure"


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
            if not another_law(view.whole, found, out):
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


def doubt_all(state: State, view: View, sure: float = SURE) -> dict[str, tuple[float, str]]:
    """Take out one by one the causes that cannot be any, as they are fitted now; effect -> nats, why.

    sure : standard errors from nothing that are asked
    """
    out = {}
    while doubted := [(c, why) for c in state.named if (why := doubt(state, c, sure))]:
        cause, why = doubted[-1]  # what was found last stands on the rest
        state.causes.remove(cause)
        out[cause.effect.name] = cause.found.gain, f"fitted with everything else {why}"
        settle(state, view)
    return out


def shows_in_shade(whole: Whole, found: Found) -> bool:
    """Whether deep shadow of held-out ground surely gains: what light there is asks neither the law nor the covariance of lit ground."""
    if found.guise.per_frame:
        return False
    gains = whole.held_out(whole.places(found.guise), whole.exclude(found.guise), found.spread, shade=True)
    return interval(gains, found.sizes)[0] > 0


def choose(sure: list[Found], tried: Sequence[Found] = ()) -> tuple[Found, list[str]]:
    """The best, or one with fewer values that gains nearly as much; and all that gain the same within their scatter, though these data
    be not sure of what it is confused with. tried : all that have evidence

    Values per frame can mimic what one value for all does: where the two gain the same, the one value is the cause. So it is with
    several values beside fewer of what they are confused with: light from above alone is a pedestal.
    """
    best = max(sure, key=lambda f: f.gain)
    if best.guise.per_frame:
        simple = [f for f in sure if not f.guise.per_frame and _as_good(f, best)]
        best = max(simple, key=lambda f: f.gain, default=best)
    alike = get_effect(best.effect).confused_with
    fewer = [f for f in sure if f.effect in alike and not f.guise.per_frame and len(f.amount) < len(best.amount)]
    best = max((f for f in fewer if best.more_than(f)[0] <= 0), key=lambda f: f.gain, default=best)
    likely = [f for f in tried if f not in sure and f.gain > 0 and f.effect in get_effect(best.effect).confused_with]
    group = []
    for f in sorted([*sure, *likely], key=lambda f: -f.gain):
        if f is best or best.more_than(f)[0] <= 0:
            group.append(f.effect)
    group.sort(key=lambda n: n != best.effect)
    return best, group


def judge(whole: Whole, found: Found) -> None:
    """Set what the effect gains on held-out ground."""
    # beside gains of every image nothing is left to gain: they know already how bright each is on other ground
    beside = whole.scattered.tolist() if found.beside else []
    without = [*whole.exclude(found.guise), *beside]
    found.gains, found.sizes = whole.held_out(whole.places(found.guise), without, found.spread), whole.sizes
    if get_effect(found.effect).lights_shadows:  # much ground has no shadow, and nothing to gain
        found.sizes = whole.power(whole.places(found.guise), found.amount)


def may_be_another(whole: Whole, found: Found, best: Mapping[str, Found], refused: Mapping[str, str]) -> str:
    """Why an effect may stand for what is ordinary, or as likely and not sure on its own, or ''. refused : effect -> why"""

    def sure(gains: np.ndarray) -> bool:
        return interval(gains, found.sizes)[0] > 0

    for other in [best[n] for n in get_effect(found.effect).confused_with if n in refused and n in best]:
        if refused[other.effect].endswith(ORDINARY):
            if not sure(whole.gains_beside(found, other)):
                return f"{other.effect}, of which there is an ordinary amount, explains as much of it"
        elif found.guise.per_frame:  # which stands for what one value for all does, sure or not
            judge(whole, other)
            if found.more_than(other)[0] <= 0:
                return f"{other.effect}, of which {UNSURE}, explains as much of it"
    if (mirrored := whole.mirrored(found.guise)) and not sure(
        found.gains - whole.held_out(whole.places(mirrored), whole.exclude(mirrored))
    ):
        return "what lies on the other side explains as much of it"
    own = whole.ordinary_places(found.effect)
    if get_effect(found.effect).lights_shadows and not sure(whole.held_out(whole.places(found.guise), own)):
        return "ordinary amounts of other light in shadows would explain it as well"
    if found.guise.per_frame:
        for other in best.values():
            likely = not other.guise.per_frame and other.surprise >= found.surprise
            if likely and not sure(whole.gains_beside(found, other)):
                return f"{other.effect}, of which {UNSURE}, would explain it as well"
    return ""


def _as_good(found: Found, best: Found) -> bool:
    return found.gain > SIMPLER * best.gain or best.more_than(found)[0] <= 0


def another_law(whole: Whole, found: Found, out: Outcome) -> bool:
    """Whether an effect of the reflectance law stands for another form of it, which has more to add for sure."""
    if not get_effect(found.effect).of_law:
        return False
    if not len(whole.form_places()):
        out.rejected[found.effect] = (
            found.gain,
            "the law is fitted to these images, and what is left of it has no form of its own",
        )
        return True
    added = whole.another_law(found.guise)
    if not added:
        return False
    why = f"the nominal law has another form, which gains {added:.0f} nats more beside it; the effect stands for a part of that"
    out.rejected[found.effect] = (found.gain, why)
    return True


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


def beyond_bounds(found: Found) -> bool:
    """Whether a coordinate of the first estimate is surely not within its bounds: what these allow is not what was found."""
    cls = get_effect(found.effect)
    for amount, error, column in zip(found.amount, found.error, found.guise.trial.columns, strict=True):
        for name, at in column.items():
            null, (low, high) = cls.null()[name], cls.bounds(name)
            value, least = null + amount * (at - null), SURE * error * abs(at - null)
            if value < low - least or value > high + least:
                return True
    return False


def ordinary(first: Effect) -> str:
    """Why the effect is nothing special already at a first estimate of its values, or ''."""
    cls = type(first)
    if cls.scope == "scene":
        for name, least in cls.tolerance.items():
            size = cls.size(first.values) if name not in first.values else abs(first.values[name] - cls.null()[name])
            if size < least / 2:
                return f"{name} is {size:.2g}, and less than {least:.2g} {ORDINARY}"
    return ""


def _fit_beside(state: State, view: View, cause: Cause) -> tuple[View, str]:
    """Fit everything with the new cause; why it, or another beside it, cannot be one, or ''.

    One that is nothing beside the new one makes way for it: the new one is something beside either. Values per frame, which mimic what
    one value for all does, drive none out.
    """
    while True:
        look = refine(state, view)
        why, other = _doubt_any(state, cause)
        if not why:
            errors_over_images(state, look)
            why, other = _doubt_any(state, cause)
        if other is None or cause.found.guise.per_frame or ODD in why:
            return look, why
        state.causes.remove(other)


def _doubt_any(state: State, cause: Cause) -> tuple[str, Cause | None]:
    """Why the cause, or another beside it, cannot be one, or ''; and which other."""
    if why := doubt(state, cause):
        return why, None
    for c in state.named:
        if why := doubt(state, c):
            return f"beside it {c.effect.name} is no cause any more: {why}", c
        # each may stand for the other: together they are sure, and how much there is of either is not known
        alike = c.effect.name in cause.effect.confused_with and c is not cause
        if alike and not (_known_by_itself(cause) or _known_by_itself(c)):
            return f"beside it {c.effect.name}, which it is confused with, is not known any more", None
    return "", None


def _known_by_itself(cause: Cause) -> bool:
    """Whether any of its values is surely not nothing, whatever all the others are."""
    null = type(cause.effect).null()
    amounts = [
        (float(cause.effect.values[n]) - null[n], e) for n, e in cause.errors.items() if n not in cause.effect.shaped
    ]
    return type(cause.effect).scope != "scene" or any(abs(value) > STILL * error for value, error in amounts)


def contradicted(gains: np.ndarray) -> str:
    """Why test pairs that gain so many nats on each piece of ground take a name back, or ''."""
    low, high = interval(gains)
    if high < 0:
        return f"the test pairs contradict it: it gains {gains.sum():.3g} nats there ({low:.3g} .. {high:.3g})"
    return ""


def doubt(state: State, cause: Cause, sure: float = SURE) -> str:
    """Why the fitted values cannot be a cause, or ''."""
    cls = type(cause.effect)
    if cls.scope == "image":
        size, error = cause.rms, cause.errors.get("rms", math.inf)
        least = max(cls.tolerance.values(), default=0.0)
        return f"it is {size:.2g}, and less than {least:.2g} {ORDINARY}" if size - 2 * error < least else ""
    values = {k: float(v) for k, v in cause.effect.values.items()}
    if not cls.plausible(values, state.data):
        return ODD
    for name in [n for n in cause.errors if n not in cls.shaped]:  # a shape may end anywhere
        value, near = values[name], cause.of_given_shape.get(name, 1e-9)
        bounds = [b for b in cls.bounds(name) if b != cls.null()[name]]
        if any(abs(value - b) < near for b in bounds):
            return f"{ODD}: {name} ends at {value:.3g}, within an error of a bound of what is possible"

    # an effect that may be nothing has no shape that could be uncertain
    if cause.away < together(sure, len(cause.of_given_shape)):
        return f"it comes out {cause.away:.1f} errors from nothing"
    if cause.share_error * student_quantile(cause.share_freedom) > 1:
        return f"other images give it other values: {1 / cause.share_error:.1f} errors over images from nothing"
    errors = cause.larger_errors
    reported = cls.report(values, errors)
    for name, least in cls.tolerance.items():
        size, error = reported[name]
        if name in values:
            size, error = abs(values[name] - cls.null()[name]), errors.get(name, 0.0)
        if size - 2 * error < least:
            return f"{name} is {size:.2g}, and less than {least:.2g} {ORDINARY}"
    return ""


def secant_gains(
    state: State, cause: Cause, look: View, before: View | None
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Nats that the cause, as it was rendered, gains beside everything else: on held-out ground, and what they go with (labels,); the squares
    without it; its gains on the test pairs, which are ``before`` as they were without it.

    Effects with several values keep the gain that their columns had on held-out ground: one amount for all would not be held out. On the
    test pairs it is, but of values per image.
    """
    others = [c.effect for c in state.causes if c is not cause]
    few = 1 + sum(n.startswith("coefficient") for n in look.plan.shared)
    flat = Covariance.white(look.grid.annuli, state.frames)
    pieces = [
        more
        for k, chain in enumerate(state.chains())
        for more in _with_cause(state, chain, others, [r for r in look.rows if r.patch.site == k], look)
    ]
    plain = [products(_few(more, few), flat, look.grid, state.frames).gram for more in pieces]
    cause.rms_before, cause.rms_after = _rms(np.sum(plain, 0), look)
    units = [products(more, look.model, look.grid, state.frames) for more in pieces]
    whole = _beside(units, cause, look, state.frames)
    total = float(whole.gram[0, 0])
    if type(cause.effect).scope != "scene":
        return cause.found.gains, cause.found.sizes, total, np.zeros(0)
    form = whole.stood_for([type(cause.effect)])
    if cause.found.beside:
        form += (look.whole.scattered + 1).tolist()  # one shared column more
    place = np.array([whole.first - 1])
    tested = [
        products(more, look.model, look.grid, state.frames)
        for chain, rows in hidden_rows(state, before, look.plan)
        for more in _with_cause(state, chain, others, rows, look)
    ]
    gains = whole.gains_on(tested, place, form)
    grounds = [u.site for u in tested]
    if len(set(grounds)) >= 3:  # else pieces of ground, where there are too few grounds for an interval
        gains = np.bincount(grounds, weights=gains).astype(np.float64)
    if not cause.single:
        return cause.found.gains, cause.found.sizes, total, gains
    shades = type(cause.effect).lights_shadows
    return whole.held_out(place, form), whole.power(place, np.ones(1)) if shades else cause.found.sizes, total, gains


def _few(rows: Rows, count: int) -> Rows:
    """The first and the last of the shared columns, and none per frame."""
    keep = [*range(count), -1]
    return dataclasses.replace(
        rows,
        shared=rows.shared[keep],
        shared_mean=rows.shared_mean[keep],
        shared_dark=0 * rows.shared_dark[keep],
        own=rows.own[:0],
        own_mean=rows.own_mean[:0],
    )


def _beside(units: Sequence[Products], cause: Cause, look: View, frames: int) -> Whole:
    """Everything but the cause's own values, what it brought as the last shared column."""
    whole = Whole(units, dataclasses.replace(look.plan, shared=[*look.plan.shared, "secant"]), frames)
    for k in [k for k, n in enumerate(look.plan.shared) if n.startswith(cause.effect.name + ".")]:
        whole.precision.pop(1 + k, None)
    first = look.whole.first
    whole.precision |= {k + 1: v for k, v in look.whole.precision.items() if k >= first}  # one shared column more
    return whole


def _with_cause(state: State, chain: Chain, others: Sequence[Effect], rows: Sequence[Rows], look: View) -> list[Rows]:
    """Rows as they are without the cause, what it brought as the last column."""
    brought = (chain.render() - state.nominal.chain(chain.site, others).render())[None]
    out = []
    for row in rows:
        z, mean = row.patch.transform(brought, look.grid)
        shared, means = torch.cat([row.shared, z]), torch.cat([row.shared_mean, mean])
        dark = torch.cat([row.shared_dark, row.patch.shadow(brought)])
        for x in (shared, means, dark):
            x[0] = x[0] + x[-1]
        out.append(dataclasses.replace(row, shared=shared, shared_mean=means, shared_dark=dark))
    return out


def _rms(gram: np.ndarray, look: View) -> tuple[float, float]:
    """rms relative residual without and with the cause, the nominal coefficients fitted to either."""
    pixels = sum(float(r.patch.weight.square().sum()) for r in look.rows)
    without = np.eye(len(gram))
    with_ = without.copy()
    with_[-1, 0] = -1.0
    out = []
    for change in (without, with_):
        g = (change.T @ gram @ change)[:-1, :-1]
        fitted = np.linalg.lstsq(g[1:, 1:], g[1:, 0], rcond=1e-9)[0]
        out.append(math.sqrt(max(g[0, 0] - fitted @ g[1:, 0], 0.0) / max(pixels, 1.0)))
    return out[0], out[1]


__all__ = ["Outcome", "doubt_all", "search"]
