"""The extended model on pairs that nothing was fitted to, and what the data could not have shown."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from stages.diagnose.likelihood.jackknife import gain_interval
from stages.diagnose.model.aligned import aligned
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import Nominal, fit, full_light, lit_mask, scale_images
from stages.diagnose.model.sites import Site
from stages.diagnose.result.answer import Answer, HeldOut, Named
from stages.diagnose.rows.patches import cuts
from stages.diagnose.search.select import Outcome
from stages.diagnose.search.state import State
from stages.diagnose.settings import CORRELATED, FAINT, SURE
from stages.effects import Effect, effect_names, get_effect

# errors that a value which shadows tell may be nearer to nothing, if lit ground likes it
NEARER = np.linspace(0, 2, 5)


def beside_shadows(
    state: State, shaded: Sequence[Named]
) -> tuple[Sequence[Named], Nominal, dict[str, tuple[float, str]]]:
    """The causes that shadows tell, the nominal model as it is fitted beside them; and effect -> nats, why, where the test pairs surely lose by that.

    Shadows are judged whatever the law: nothing was fitted beside their cause yet, and a Sun that stands higher makes all ground brighter. What is found
    because it is large is found too large: up to two errors nearer to nothing the value is the one that lit ground makes likeliest.
    """
    tried = [[_nearer(cause, errors) for cause in shaded] for errors in NEARER]
    models = [(_fitted_beside(state, causes), causes) for causes in tried]
    squares, pixels = _squares_of(state, state.sites, models)
    cost = [pixels / CORRELATED * math.log(x.sum()) + e**2 for x, e in zip(squares, NEARER, strict=True)]
    best, kept = models[int(np.argmin(cost))]
    (before, after), _ = _squares_of(state, state.hidden, [(_fitted_beside(state, []), []), (best, kept)])
    gain, _, high = gain_interval(before, after)
    if not contradicts(high):
        return kept, best, {}
    return [], state.nominal, {c.effect.name: (c.gain, contradiction(gain, high)) for c in shaded}


def _fitted_beside(state: State, shaded: Sequence[Named]) -> Nominal:
    """The nominal model, fitted again beside all causes and these."""
    nominal = copy.copy(state.nominal)
    effects = [*state.base, *(c.effect for c in shaded)]
    fit(nominal, state.sites, effects, state.units, [s.laid for s in state.sites])
    return nominal


def _squares_of(
    state: State, sites: Sequence[Site], models: Sequence[tuple[Nominal, Sequence[Named]]]
) -> tuple[list[np.ndarray], float]:
    """Squared errors on every piece of ground of every model, beside causes that shadows tell, on the same pixels; and how many these are."""
    out: list[list[np.ndarray]] = [[np.zeros(0)] for _ in models]
    count = 0.0
    for site in sites:
        site.align()
        chains = [nominal.chain(site, [*state.base, *(c.effect for c in shaded)]) for nominal, shaded in models]
        mask = torch.stack([lit_mask(chain) for chain in chains]).all(0)
        for part, chain in zip(out, chains, strict=True):
            squares, _, pixels = _squares(site, chain, site.laid, mask, state)
            part.append(squares)
        count += pixels
    return [np.concatenate(part) for part in out], count


def _nearer(cause: Named, errors: float) -> Named:
    """The cause with its first value so many errors nearer to nothing."""
    effect = cause.effect
    name = effect.fitted()[0].name
    value, error, unit = cause.parameters[name]
    value -= math.copysign(errors * error, value - effect.null()[name])
    made = type(effect)({**effect.values, name: value}, effect.survey)
    return dataclasses.replace(cause, effect=made, parameters={**cause.parameters, name: (value, error, unit)})


def contradicts(high: float) -> bool:
    """Whether test pairs surely lose by a cause: by more than the law is not known. high : upper bound of their gain, percent"""
    return high < -100 * FAINT**2


def contradiction(gain: float, high: float) -> str:
    """Why a cause is none: percent that the squared error of the test pairs shrinks by, and the upper bound of that."""
    return f"the test pairs contradict it: it gains {gain:.1f} % there (up to {high:.1f})"


def score(state: State, answer: Answer, extended: Nominal) -> HeldOut:
    """Squared errors of both models on the same pixels, with the same nuisance: a law that was fitted last to the same images, the albedo of every
    pixel that several images show, gains of dn images, smooth fields of displacement.

    extended : as it was fitted beside the causes

    Relative to brightness for dn images, else in I/F. What registration found counts where it is named, else both have it.
    """
    if not state.hidden or not answer.causes:
        return HeldOut()
    nominal = state.plain()
    named = [c.effect for c in answer.causes if c.effect.displaces and c.effect.judged_apart]
    cut = [c.effect for c in answer.causes if c.effect.keep_below < 1]
    effects = [c.effect for c in answer.causes if c.effect not in [*named, *cut]]
    plain, moved = displacements(state, named)
    before: list[np.ndarray] = []
    after: list[np.ndarray] = []
    images_before, images_after = np.zeros((2, state.frames))
    count = 0.0
    for site, was, now in zip(state.hidden, plain, moved, strict=True):
        laid = [aligned(site.read, site.read_valid, *d) if d else (site.read, site.read_valid) for d in (was, now)]
        mask = full_light(nominal.chain(site, [])) & laid[0][1] & laid[1][1] & site.counts
        for effect in cut:  # of an image that is cut off nearly everywhere nobody knows how bright it would be
            below = mask & (laid[1][0] < effect.keep_below * _level(effect, state))
            mask &= (2 * below.sum((-2, -1)) > mask.sum((-2, -1)))[:, None, None]
        for part, images, chain, (image, _), off in (
            (before, images_before, nominal.chain(site, []), laid[0], False),
            (after, images_after, extended.chain(site, effects), laid[1], True),
        ):
            squares, of_images, pixels = _squares(site, chain, image, mask, state, cut, off)
            part.append(squares)
            np.add.at(images, site.frames, of_images)
        count += pixels
    if not count > 0:
        return HeldOut()
    first, last = np.concatenate(before), np.concatenate(after)
    low, high = _wider(gain_interval(first, last), (images_before, images_after))
    pairs = sum(s.count for s in state.hidden)
    return HeldOut(pairs, len(state.hidden), first.sum() / count, last.sum() / count, low, high)


def _wider(over_ground: tuple[float, float, float], images: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """The interval of a gain that holds both the one over pieces of ground and the one over images: pieces of one ground share what each image has of
    its own, its gain say, and images what the ground has. images : squares of every frame before and after
    """
    seen = images[0] > 0
    over_images = gain_interval(images[0][seen], images[1][seen])
    return float(np.fmin(over_ground[1], over_images[1])), float(np.fmax(over_ground[2], over_images[2]))


def displacements(state: State, named: Sequence[Effect]) -> tuple[Fields, Fields]:
    """Where the test images look under the nominal and the extended model; None: where the ground is.

    Beyond one shift per frame a field is a nuisance: either model then has each image's own.
    """
    r, nothing = state.registration, [None] * len(state.hidden)
    if r is None or not r.displaced:
        return nothing, nothing
    chains = [state.nominal.chain(site, []) for site in state.hidden]
    leans = any(e.leans for e in named)
    plain: Fields
    if leans or r.form.terms > 1:
        last = r.settled(chains, r.share if r.form.leaning else 0.0)
        plain = r.settled(chains, 0.0) if leans else last
    else:
        last = [r.at(chain) for chain in chains]
        plain = nothing if any(not e.along_lines for e in named) else last
    moved = r.beside_lines(chains, last)
    unnamed = plain is last and not any(e.along_lines for e in named)
    return (moved if unnamed else plain), moved


Fields = list[tuple[torch.Tensor, torch.Tensor]] | list[None]


def _squares(
    site: Site,
    chain: Chain,
    image: torch.Tensor,
    mask: torch.Tensor,
    state: State,
    cut: Sequence[Effect] = (),
    off: bool = False,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Squared errors of the pieces of one ground and of its images, and its number of pixels. Where several images show a pixel its own albedo is
    a nuisance: one factor for all of them.

    Without it albedo, which no cause is about, would drown what the images of a place disagree on.
    cut : effects that cut off what is brighter than a level of the detector, which says nothing of albedo and gain; off : whether the model does so
    """
    known = mask
    for effect in cut:
        known = known & (image < effect.keep_below * _level(effect, state))
    site.image = image
    predicted = chain.predict()
    free = state.free_gains
    if free:
        scale_images(site, image, predicted, known)
    weight = mask.double()
    measured = site.image
    relative = torch.ones_like(measured[:, :1, :1])
    if free:  # relative to the image as it was read: one that lies beside the ground has a low gain, and says little
        level = (image * weight).sum((-2, -1)) / weight.sum((-2, -1)).clamp(min=1)
        relative = (site.gain / level.clamp(min=1e-9))[:, None, None]
        measured, predicted = measured * relative, predicted * relative
    if len(weight) > 1:
        weight = weight * (weight.sum(0) > 1)
        tells = weight * known
        seen = (tells * predicted.square()).sum(0)
        predicted = predicted * torch.where(
            seen > 0, (tells * predicted * measured).sum(0) / seen.clamp(min=1e-12), 1.0
        )
    for effect in cut if off else ():
        top = (_level(effect, state) - site.offset) / site.gain
        predicted = torch.minimum(predicted, top[:, None, None] * relative)
    every = ((measured - predicted).double() * weight).square()
    squares = every.sum(0)
    # one or two grounds are cut, as those are that are learned from: there would be no interval
    pieces = cuts(min(squares.shape), len(state.hidden)) if len(state.hidden) < 3 else 1
    parts = [part.sum() for rows in squares.tensor_split(pieces) for part in rows.tensor_split(pieces, 1)]
    return torch.stack(parts).numpy(), every.sum((-2, -1)).numpy(), float(weight.sum())


def _level(effect: Effect, state: State) -> float:
    """At which it cuts images off as they were read, whatever their own gains; its value is in I/F by the middle one."""
    ((_, value),) = effect.values.items()
    gain, offset = state.exposure
    return float(value) * gain + offset


def unconfirmed(state: State) -> dict[str, tuple[float, str]]:
    """Take out causes of the search that surely lose on the test pairs, the last one first; name -> its gain in nats where it was learned, and why."""
    out: dict[str, tuple[float, str]] = {}
    for cause in state.named[::-1]:  # what was found last stands on what was found before
        kept, nominal = list(state.causes), state.nominal
        if not cause.found.guise.per_frame and not any(bool(site.counts.any()) for site in state.hidden):
            # no values per image are known of images that the test pairs alone are of: without these it is judged all the same
            state.causes[:] = [c for c in kept if not c.found.guise.per_frame]
            state.nominal = copy.copy(nominal)
            state.fit()
        with_cause, with_images = _hidden_squares(state)
        predicted = [c.predict() for c in _hidden_chains(state)]
        state.causes[:] = [c for c in state.causes if c is not cause]
        by_itself, _ = _hidden_squares(state, predicted)  # what it changes beside the same law
        state.nominal = copy.copy(state.nominal)
        state.fit()
        without, without_images = _hidden_squares(state)
        over_ground = gain_interval(without, with_cause)
        gain, (_, high) = over_ground[0], _wider(over_ground, (without_images, with_images))
        # what all images of a place share, albedo say, these pairs do not judge: it is the law that makes a difference, fitted without it.
        # Light in shadows is none of that, though it changes next to nothing on lit ground
        judged = cause.effect.lights_shadows or by_itself.sum() > FAINT**2 * with_cause.sum()
        if contradicts(high) and judged:
            out[cause.effect.name] = cause.found.gain, contradiction(gain, high)
            kept.remove(cause)
        state.causes[:], state.nominal = kept, nominal
        state.fit()
    return out


def _hidden_chains(state: State) -> list[Chain]:
    """The test pairs under the model so far."""
    for site in state.hidden:
        site.align()
    return [state.nominal.chain(site, state.base) for site in state.hidden]


def _hidden_squares(state: State, images: Sequence[torch.Tensor] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors on every piece of ground of the test pairs and, (frames,), of every image, on what the nominal model says is lit, as ``score``
    has it: a shadow that a cause casts where there is none counts against it. images : in the place of theirs, in I/F
    """
    ground, of_frames = [np.zeros(0)], np.zeros(state.frames)
    for k, chain in enumerate(_hidden_chains(state)):
        site = chain.site
        image = site.laid if images is None else images[k] * site.gain[:, None, None] + site.offset[:, None, None]
        mask = site.valid & full_light(state.nominal.chain(site, [])) & site.counts
        squares, of_images, _ = _squares(site, chain, image, mask, state)
        ground.append(squares)
        np.add.at(of_frames, site.frames, of_images)
    return np.concatenate(ground), of_frames


def blind_effects(state: State, outcome: Outcome, named: set[str]) -> list[str]:
    """Effects that these data could not have shown at a size worth knowing, and that are not named all the same."""
    return [n for n in effect_names() if n not in named and _could_not_show(state, outcome, n)]


def _could_not_show(state: State, outcome: Outcome, name: str) -> bool:
    """Whether the expected error is too large, or came out too large where the effect was tried."""
    cls = get_effect(name)
    if cls.judged_apart:
        return False
    if name not in state.open_names() or name not in outcome.best:
        return True
    assert outcome.view is not None
    whole = outcome.view.whole
    if cls.of_law and not len(whole.form_places()):  # a law that is fitted follows it
        return True
    found = state.open.get(name, 0.0)  # over ground or images, larger than the likelihood's
    expected: dict[str, float] = {}  # coordinate -> the least of all guises; every coordinate must show
    for guise in (g for g in whole.plan.guises if g.effect == name):
        every = whole.expected_errors(guise)
        if guise.per_frame:
            # values that scatter by a size worth knowing add s - log(1 + s) each to twice the log likelihood, s in squares of their errors
            seen = 1 / np.maximum(every, 1e-6) ** 2
            expected["rms"] = 1 / math.sqrt(max(float((seen - np.log1p(seen)).sum()), 1e-12))
            continue
        for column, error in zip(guise.trial.columns, every, strict=True):
            ((coordinate, at),) = column.items()
            size = abs(at - cls.null()[coordinate])
            error = math.hypot(float(error) * size, state.law_errors(cls).get(coordinate, 0.0))
            error /= cls.strong.get(coordinate, 0.0) or size
            expected[coordinate] = min(expected.get(coordinate, math.inf), error)
    error = max(expected.values(), default=math.inf)
    judged = outcome.best[name]
    if len(judged.gains):
        # what such a size would add, and how far gains scatter over other ground
        low, high = judged.gain_interval()
        if 0.5 / error**2 < (high - low) / 2:
            return True
    return SURE * max(found, error) > 1


__all__ = ["beside_shadows", "blind_effects", "contradiction", "contradicts", "score", "unconfirmed"]
