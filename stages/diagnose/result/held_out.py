"""What the extended model gains on test pairs, which nothing was fitted to and nothing was decided by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from stages.diagnose.data.aligned import aligned
from stages.diagnose.data.sites import Site
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.intervals import gain_interval
from stages.diagnose.likelihood.patches import cuts
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import Nominal, full_light, scale_images
from stages.diagnose.result.answer import Answer, HeldOut
from stages.effects import Effect

Fields = list[tuple[torch.Tensor, torch.Tensor]] | list[None]


def score(state: State, answer: Answer, extended: Nominal) -> HeldOut:
    """Squared errors of both models on the same pixels, with the same nuisance: a law that was fitted last to the same images, the albedo of every
    pixel that several images show, gains of dn images, smooth fields of displacement.

    extended : as it was fitted beside the causes

    Relative to brightness for dn images, else in I/F. What registration found counts where it is named, else both have it.
    """
    if not state.hidden or not answer.causes:
        return HeldOut()
    nominal = state.beside([])
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


__all__ = ["displacements", "score"]
