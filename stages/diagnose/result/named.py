"""Causes as they are reported: those of the search, of the registration, and what a histogram shows by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.likelihood.jackknife import folds, gain_chance, gain_interval, jackknife_error, nats
from stages.diagnose.model.nominal import full_light
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.forms import FORMS
from stages.diagnose.registration.lines import STEADY, TREMBLING
from stages.diagnose.registration.registered import Registration, shifted_frames
from stages.diagnose.registration.squares import OWN
from stages.diagnose.registration.sunward import sunward
from stages.diagnose.result.answer import Named
from stages.diagnose.search.doubts import doubt_size, with_ordinary
from stages.diagnose.search.state import State
from stages.diagnose.settings import CORRELATED, ROUNDS
from stages.effects import Effect, Survey, effect_names, get_effect
from stages.effects.filters import gaussian

ENDLESS = 1e9  # a gain that takes all lit ground beyond any level


def by_search(state: State) -> list[Named]:
    """The causes that the search found, with errors and units."""
    out = []
    for cause in state.named:
        cls = type(cause.effect)
        units = {p.name: p.unit for p in cls.parameters}
        if cls.scope == "scene":
            values = {k: float(v) for k, v in cause.effect.values.items()}
            found = cls.report(values, state.reported_errors(cause))
        else:
            found = {cls.parameters[0].name: (cause.rms, state.reported_errors(cause).get("rms", math.inf))}
        low, high = cause.found.gain_interval()
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
                [n for n in cause.group if get_effect(n).listed],
            )
        )
    return out


def outside_catalogue(state: State) -> dict[str, float]:
    """What was found and stands in no catalogue, in words, and the share of the squares that it takes away; it is no cause from here on."""
    out = {}
    for cause in [c for c in state.named if not c.effect.listed]:
        cause.ordinary = True
        first = type(cause.effect).parameters[0].name
        value, error = float(cause.effect.values[first]), state.reported_errors(cause).get(first, math.nan)
        out[_in_words(cause.effect, value, error)] = cause.gain_percent / 100
    return out


def by_catalogue(found: Sequence[Named]) -> tuple[list[Named], dict[str, float]]:
    """Those that stand in it, and the others like :func:`outside_catalogue`."""
    out = {}
    for cause in [c for c in found if not c.effect.listed]:
        value, error, _ = cause.parameters[type(cause.effect).parameters[0].name]
        out[_in_words(cause.effect, value, error)] = cause.percent[0] / 100
    return [c for c in found if c.effect.listed], out


def _in_words(effect: Effect, value: float, error: float) -> str:
    """What an effect does, and the size of its first parameter."""
    unit = type(effect).parameters[0].unit
    return f"{effect.title} ({value:.2g} +- {error:.1g}{'' if unit == '1' else ' ' + unit})"


def by_registration(state: State) -> tuple[list[Named], dict[str, tuple[float, str]]]:
    """What explains where the images lie: relief displacement, and shifts of whole images beyond ordinary ones; and what was refused."""
    r = state.registration
    if r is None:
        return [], {}
    if r.displaced:
        r.test(state.hidden, state.nominal)
    out: list[Named] = []
    refused: dict[str, tuple[float, str]] = {}
    for name in effect_names():
        cls = get_effect(name)
        if cls.displaces and cls.judged_apart:
            explained = _leaning if cls.leans else _lines if cls.along_lines else _shifts
            made, why = explained(state, r, name)
            if made is not None and why:
                refused[name] = (made.gain, why)
            elif made is not None:
                out.append(made)
    return sorted(out, key=lambda cause: -cause.gain), refused


def _named(effect, parameters, r: Registration, first: str, second: str, frames=None) -> Named:
    """The second form's gain over the first, of some frames or all."""
    gain = r.gain(first, second, frames)
    before, after = r.rms[first], r.rms[second]
    percent = (gain.percent, gain.low, gain.high)
    return Named(effect, parameters, *r.evidence(first, second, frames), before, after, percent, [effect.name])


def _leaning(state: State, r: Registration, name: str) -> tuple[Named | None, str]:
    lean = state.data.lean_px
    if not r.form.leaning or not lean > 0:
        return None, ""
    effect = get_effect(name)({"share": r.share}, state.data)
    error = with_ordinary(abs(r.share) * lean, r.share_error * lean, type(effect))
    parameters = {"share": (r.share, error / lean, "1"), "rms_px": (abs(r.share) * lean, error, "px")}
    plain = r.form.upright
    compared = (plain.name, r.form.name)
    if not plain.terms or r.doubt(*compared, OWN):  # beside each image's own shift it was found sure
        compared = OWN
    why = doubt_size(abs(r.share) * lean, r.share_error * lean, type(effect)) or r.doubt(*compared, OWN)
    return _named(effect, parameters, r, *compared), why


def _lines(state: State, r: Registration, name: str) -> tuple[Named | None, str]:
    """Line jitter, where one half of each line predicts the shift of the other half, and why it gets no name, or ''."""
    if not r.lines_tremble:
        return None, ""
    cls = get_effect(name)
    amounts = r.lines.over_the_crop(state.sites, state.frames)
    effect = cls({p.name: amounts[:, k] for k, p in enumerate(cls.fitted())}, state.data)
    compared, size = (STEADY, TREMBLING), r.lines.rms
    made = _named(effect, {"rms_px": (size, with_ordinary(size, r.lines.error, cls), "px")}, r, *compared)
    return made, doubt_size(size, r.lines.error, cls) or r.doubt(*compared, compared)


def _shifts(state: State, r: Registration, name: str) -> tuple[Named | None, str]:
    """Named where one shift per frame gains for sure, of all frames or of some, alone or beside relief displacement, and is more than ordinary."""
    cls = get_effect(name)
    if not r.form.terms:
        return None, ""

    def judge(leaning: bool) -> tuple[str, str, NDArray[np.int64] | None, str]:
        """The forms without and with a shift, the frames that are shifted (None for all), and why that is not sure."""
        first, form = (next(f.name for f in FORMS if f.terms == n and f.leaning == leaning) for n in (0, 1))
        why = r.doubt(first, form, (first, form))
        some = shifted_frames(r.squares[first], r.squares[form])
        if why and len(some):
            return first, form, some, r.doubt(first, form, (first, form), some)
        return first, form, None, why

    first, form, frames, why = judge(r.form.leaning)
    some = shifted_frames(r.squares[first], r.squares[r.form.name])
    if why and r.form.terms > 1 and len(some):  # a shift is part of what displaces these frames
        form, frames = r.form.name, some
        why = r.doubt(first, form, (first, form), some)
    if not why and not r.form.leaning and judge(True)[3]:
        why = "relief displacement, of which these data are not sure, would explain it as well"

    def made(coefficients: Tensor) -> Effect:
        shifts = r.mean_shifts(state.sites, coefficients)
        if frames is not None:
            shifts[np.setdiff1d(np.arange(state.frames), frames)] = 0.0
        return cls({"east_px": shifts[:, 0], "south_px": shifts[:, 1]}, state.data)

    effect = made(r.fitted[form][0])
    size = cls.size(effect.values)
    scatter = float(jackknife_error(np.array([cls.size(made(c).values) for c in r.without[form]])))
    error = max(scatter, r.shift_error)
    why = doubt_size(size, error, cls) or why
    if not why and sunward(r.mean_shifts(state.sites, r.fitted[form][0]), state.sites):
        why = "albedo that follows the ground's curvature looks the same: shifts along the Sun's azimuth that grow with the tangent of its elevation"
    return _named(effect, {"rms_px": (size, with_ordinary(size, error, cls), "px")}, r, first, form, frames), why


Cut = tuple[Callable[[Survey, State], Named | None], float]  # what makes the cause of it, share of the pixels


def by_histogram(sites: Sequence[Site], units: str) -> Cut | None:
    """Read effects off the histogram of all pixels, mask what they spoilt, and return what makes the cause of it, and their share of the pixels.

    The cause is None where clipping the prediction at the level does not surely bring it nearer to ground that the level was not read off from.
    """
    bright = torch.cat([s.read[s.read_valid].flatten() for s in sites])
    for name in effect_names():
        cls = get_effect(name)
        found = cls.read_off(bright)
        if found is None:
            continue
        level, error, _ = found
        share = float((bright > level - error).float().mean())
        images, masks = [s.read for s in sites], [s.read_valid for s in sites]
        for site in sites:
            near: Tensor = gaussian(torch.where(site.read_valid, site.read, 0.0), 1.0)
            site.read_valid = (
                site.read_valid & (site.read < cls.keep_below * level) & (near < cls.keep_below**3 * level)
            )
            site.valid = site.read_valid

        def make(
            data: Survey, state: State, cls=cls, level=level, error=error, images=images, masks=masks
        ) -> Named | None:
            before, after, pixels = _clipped(state, images, masks, cls)
            percent = gain_interval(before, after)
            if not percent[1] > 0:
                return None
            gain, offset = state.exposure
            (parameter,) = cls.parameters
            value = (level - offset) / gain
            effect = cls({parameter.name: value}, data)
            values = {parameter.name: (value, error / gain, parameter.unit)}
            total = nats(float(before.sum()), float(after.sum()), pixels, CORRELATED)
            spread = total * (percent[2] - percent[1]) / (4 * percent[0])
            was, now = (math.sqrt(float(x.sum()) / pixels) for x in (before, after))
            return Named(effect, values, gain_chance(before, after), total, spread, was, now, percent, [cls.name])

        return make, share
    return None


def _own_gain(image: Tensor, plain: Tensor, use: Tensor, top: float = math.inf) -> Tensor:
    """(n, 1, 1) by least squares over the pixels in use, of what is cut off at ``top``; image, plain, use : (n, H, W)."""
    gain = torch.ones_like(plain[:, :1, :1])
    for _ in range(ROUNDS if math.isfinite(top) else 1):
        below = use & (gain * plain < top) if math.isfinite(top) else use
        across = (image * plain * below).sum((-2, -1), keepdim=True)
        found = across / (plain.square() * below).sum((-2, -1), keepdim=True).clamp(min=1e-12)
        # of an image that is cut off as a whole any gain is as good that is high enough
        gain = torch.where(below.any(-1, keepdim=True).any(-2, keepdim=True), found, ENDLESS)
    return gain


def _albedo(image: Tensor, plain: Tensor, tells: Tensor) -> Tensor:
    """(n, H, W) factors on the predicted brightness of every image by which its ground is brighter in the other images; 1 where none tells."""
    across, power = image * plain * tells, plain.square() * tells
    across, power = across.sum(0) - across, power.sum(0) - power
    return torch.where(power > 0, across / power.clamp(min=1e-12), 1.0)


def _clipped(
    state: State, images: Sequence[Tensor], masks: Sequence[Tensor], cls: type[Effect]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Squared relative residuals of every quarter of a site's ground, without and with the level of the other ground; their pixels.

    Every image has its own gain, fitted to its other quarters where these are not cut off, for the law may be extrapolated to it, and the albedo that
    the other images of its ground show: it is bright ground that is cut off.
    """
    quarters = [(k, rows) for k, x in enumerate(images) for rows in range(4)]

    def part(k: int, quarter: int, x: Tensor) -> Tensor:
        side = x.shape[-2] // 4
        return x[:, quarter * side : (quarter + 1) * side]

    levels = []
    group = [k if len(images) > 3 else n for n, (k, _) in enumerate(quarters)]
    of = folds(max(group) + 1)
    for fold in range(of.max() + 1):
        rest = [
            part(*q, images[q[0]])[part(*q, masks[q[0]])] for q, g in zip(quarters, group, strict=True) if of[g] != fold
        ]
        found = cls.read_off(torch.cat([r.flatten() for r in rest])) if rest else None
        levels.append(found[0] if found else math.inf)
    chains = state.chains()
    out, count = [], 0.0
    for (k, quarter), g in zip(quarters, group, strict=True):
        site = chains[k].site
        predicted = chains[k].predict() * site.gain[:, None, None] + site.offset[:, None, None]
        elsewhere = masks[k] & full_light(chains[k])
        lit = part(k, quarter, elsewhere).clone()
        part(k, quarter, elsewhere)[:] = False
        image, plain = part(k, quarter, images[k]), part(k, quarter, predicted)
        level = images[k][masks[k]].mean()
        top = levels[of[g]]
        gain = _own_gain(images[k], predicted, elsewhere, top)
        # without the level an image that it cuts off as a whole is as bright as it looks
        without = torch.where(gain < ENDLESS, gain, _own_gain(images[k], predicted, elsewhere))
        tells = part(k, quarter, masks[k]) & lit & (image < cls.keep_below * top) & (gain < ENDLESS)
        plain = plain * _albedo(image, gain * plain, tells)
        both = [torch.where(lit, image - p, 0.0) / level for p in (without * plain, (gain * plain).clamp(max=top))]
        out.append([float(left.double().square().sum()) for left in both])
        count += float(lit.sum())
    before, after = np.array(out).T
    return before, after, max(count, 1.0)


__all__ = ["Cut", "by_histogram", "by_registration", "by_search", "outside_catalogue"]
