"""Causes as they are reported: those of the search, of the registration, and what a histogram shows by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from stages.diagnose.likelihood.weigh import interval
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.explain import Registration
from stages.diagnose.registration.forms import FORMS
from stages.diagnose.result.answer import Named
from stages.diagnose.search.state import State
from stages.diagnose.settings import SURE
from stages.effects import Survey, effect_names, get_effect
from stages.effects.filters import gaussian


def by_search(state: State) -> list[Named]:
    out = []
    for cause in state.causes:
        cls = type(cause.effect)
        units = {p.name: p.unit for p in cls.parameters}
        if cls.scope == "scene":
            values = {k: float(v) for k, v in cause.effect.values.items()}
            found = cls.report(values, cause.errors)
        else:
            found = {cls.parameters[0].name: (cls.size(cause.effect.values), cause.errors.get("rms", 0.0))}
        low, high = interval(cause.found.gains)
        out.append(
            Named(
                cause.effect,
                {k: (v, e, units[k]) for k, (v, e) in found.items()},
                cause.found.p,
                cause.found.gain,
                (high - low) / 4,
                cause.rms_before,
                cause.rms_after,
                (cause.gain_percent, cause.gain_low, cause.gain_high),
                cause.group,
            )
        )
    return out


def by_registration(state: State) -> list[Named]:
    """What explains where the images lie: relief displacement, and shifts of whole images beyond ordinary ones."""
    r = state.registration
    if r is None:
        return []
    out = []
    for name in effect_names():
        cls = get_effect(name)
        if cls.displaces and cls.never_named:
            made = _leaning(state, r, name) if cls.leans else _shifts(state, r, name)
            if made is not None:
                out.append(made)
    return out


def _named(effect, parameters, percent: tuple[float, float, float], squares: tuple[float, float]) -> Named:
    # independent samples of the residual are wider than a pixel; nats are left to the search, where covariances are known
    before, after = (math.sqrt(max(s, 0.0)) for s in squares)
    return Named(effect, parameters, math.nan, math.nan, math.nan, before, after, percent, [effect.name])


def _leaning(state: State, r: Registration, name: str) -> Named | None:
    if not r.form.leaning or not r.leaning.low > 0 or abs(r.share) < SURE * r.share_error:
        return None
    effect = get_effect(name)({"share": r.share}, state.data)
    size = abs(r.share) * state.data.lean_px
    parameters = {
        "share": (r.share, r.share_error, "1"),
        "rms_px": (size, r.share_error * state.data.lean_px, "px"),
    }
    plain = next(f for f in FORMS if f.terms == r.form.terms and not f.leaning)
    return _named(
        effect, parameters, (r.leaning.percent, r.leaning.low, r.leaning.high), (r.rms[plain.name], r.rms[r.form.name])
    )


def _shifts(state: State, r: Registration, name: str) -> Named | None:
    """Named where one shift per frame gains for sure, alone or beside relief displacement, and is more than ordinary."""
    cls = get_effect(name)
    first = next(f for f in FORMS if f.terms == 0 and f.leaning == r.form.leaning)
    best = None
    for form in FORMS:
        if form.leaning == r.form.leaning and 0 < form.terms <= r.form.terms:
            gain = r.gain(first, form)
            if gain.low > 0 and (best is None or gain.low > best[1].low):
                best = form, gain
    if best is None:
        return None
    form, gain = best
    shifts = r.mean_shifts(state.sites, state.frames)
    effect = cls({"east_px": shifts[:, 0], "south_px": shifts[:, 1]}, state.data)
    size = cls.size(effect.values)
    if size < max(cls.tolerance.values()):
        return None
    return _named(
        effect,
        {"rms_px": (size, r.shift_error, "px")},
        (gain.percent, gain.low, gain.high),
        (r.rms[first.name], r.rms[form.name]),
    )


def by_histogram(sites: Sequence[Site], units: str) -> Callable[[Survey, State], Named] | None:
    """Read effects off the histogram of all pixels, mask what they spoilt, and return what makes the cause of it."""
    bright = torch.cat([s.read[s.read_valid].flatten() for s in sites])
    for name in effect_names():
        cls = get_effect(name)
        found = cls.read_off(bright)
        if found is None:
            continue
        level, error, gain = found
        for site in sites:
            near: Tensor = gaussian(torch.where(site.read_valid, site.read, 0.0), 1.0)
            site.read_valid = (
                site.read_valid & (site.read < cls.keep_below * level) & (near < cls.keep_below**3 * level)
            )
            site.valid = site.read_valid

        def make(data: Survey, state: State, cls=cls, level=level, error=error, gain=gain) -> Named:
            scale = 1.0
            if units == "dn":
                gains = torch.cat([s.gain for s in state.sites])
                offsets = torch.cat([s.offset for s in state.sites])
                scale = float(gains.median())
                level = level - float(offsets.median())
            (parameter,) = cls.parameters
            effect = cls({parameter.name: level / scale}, data)
            values = {parameter.name: (level / scale, error / scale, parameter.unit)}
            share = (math.nan, math.nan, math.nan)
            return Named(effect, values, math.nan, gain, math.sqrt(gain), math.nan, math.nan, share, [cls.name])

        return make
    return None


__all__ = ["by_histogram", "by_registration", "by_search"]
