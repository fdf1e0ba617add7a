"""Candidates taken into the model in turn: which of them deserves the name, and whether it keeps what it promised."""

from __future__ import annotations

import copy

from torch import Tensor

from stages.diagnose.answer import parameters
from stages.diagnose.columns import free_coordinates
from stages.diagnose.looking import Round, look, misfit
from stages.diagnose.naming import FLOOR_GAIN, GATE, MOVES_SHADOWS, SIMPLER, UNDERRATED, choose
from stages.diagnose.numbers import f_tail
from stages.diagnose.refining import gains_left, refine
from stages.diagnose.state import Cause, Saved, Search
from stages.effects import get_effect

MUCH = 0.05  # of what it explains: by so much a cause for each image must do better than one for all
FOR_FREE = 2.0  # of the sum of squares, that each coordinate gains by itself (Akaike 1974)
FEWER = 4  # coordinates less, which make up for doing slightly worse
SLIGHT = 0.0005  # of what is left: by so much a simpler cause may do worse
TESTS = 2  # of whether scene-wide causes do as well as gains
PAIR = 2  # scene-wide causes that are tried together in the place of gains
WORSE = 1.02  # growth of the residual that shows a cause to be a mistake
PROMISE = 0.15  # share of the foretold gain that a cause must bring once it is in the model ...
ALSO_STILL = ("psf_blur", "echo")  # ... but for these, part of whose gain lies in the maps of the ground


def contest(state: Search, rivals: list[Cause], seen: Round) -> Cause:
    """Take the cause into the model that leaves least once everything is fitted again; the state holds it afterwards.

    Where a wrong Sun is among them shadow edges have a say: it moves them, a bent response does not.
    """
    if len(rivals) == 1:
        state.causes.append(rivals[0])
        if rivals[0].effect.scope != "site":
            refine(state, 3 if rivals[0].effect.displaces else 2)
        return rivals[0]
    per_image = [k for k, c in enumerate(rivals) if c.effect.scope == "image"]  # free to follow any junk at the edges
    moves = any(c.effect.name in MOVES_SHADOWS for c in rivals)
    edges = moves and not per_image
    before, nothing = state.save(), _left(state, seen, edges)
    tried: list[tuple[float, int, Saved]] = []
    for cause in rivals:
        state.load(before)
        state.causes.append(cause)
        refine(state, 2 if cause.effect.displaces else 1)
        tried.append((nothing - _left(state, seen, edges), _freedom(cause), state.save()))
    scene_wide = [c for c in rivals if c.effect.scope == "scene"]
    if per_image and len(per_image) < len(rivals):  # a number for each image must do much better than one for all
        alone = max(tried[k][0] for k in range(len(rivals)) if k not in per_image)
        single = max(tried[k][0] - FOR_FREE * tried[k][1] for k in per_image)
        drop = alone > (1 - MUCH) * single
        keep = [k for k in range(len(rivals)) if (k in per_image) != drop]
        rivals, tried = [rivals[k] for k in keep], [tried[k] for k in keep]
        if drop and moves and len(rivals) > 1:
            state.load(before)
            nothing = _left(state, seen, edges=True)
            for k, (_, freedom, saved) in enumerate(tried):
                state.load(saved)
                tried[k] = (nothing - _left(state, seen, edges=True), freedom, saved)
    most = max(worth for worth, _, _ in tried)
    # a superset of another effect always does a little better; where much is explained, a little is much
    least = most - min((1 - SIMPLER) * abs(most), SLIGHT * max(nothing - most, 0.0))
    place = min(
        (k for k, (worth, _, _) in enumerate(tried) if worth >= least),
        key=lambda k: (tried[k][1], -tried[k][0]),
        default=0,
    )
    cause = rivals[place]
    cause.rivals = [c for c in scene_wide if c is not cause]
    state.load(tried[place][2])
    refine(state, 1)
    names = [c.effect.name for c in rivals if c is not cause]
    cause.group = [
        cause.effect.name,
        *(n for n in cause.group[1:] if n in names),
        *(n for n in cause.group[1:] if n not in names),
    ]
    return cause


def _left(state: Search, seen: Round, edges: bool) -> float:
    """Sum of squares that the model leaves, with the pixels about shadow edges or without."""
    return misfit(state, seen.edges if edges else seen.works, edges)


def instead_of_gains(state: Search, before: Saved, seen: Round, nothing: float) -> bool:
    """Gains of images can stand for any scene-wide causes that act by image; whether such causes, up to two, do as well.

    A few numbers for all images against one for each: an F test over the images of what the gains gain, and one of the
    gains themselves, each image counting alike: known to a thousandth, a dark image's gain says as much as a bright one's.
    The state holds the scene-wide causes afterwards if so (true gains may then come on top), and the gains if not.
    """
    gains, with_gains, rms = state.causes[-1], state.save(), state.residual_rms()
    scatter, count = _scatter(gains.effect.values["gain"])
    possible = nothing - misfit(state, seen.works)
    images = _effective_images(seen)
    state.load(before)
    names = [n for n in state.open_names() if get_effect(n).scope == "scene" and get_effect(n).channel == "lit"]
    freedom, choices = 0, 1
    for _ in range(PAIR):
        rivals = choose(state, look(state, names))
        if not rivals:
            break
        known = state.save()
        cause = contest(state, rivals, seen)
        cause.rms_before, cause.rms_after = gains.rms_before, rms
        reconsider(state, cause, known, seen, kept=True)
        choices *= len(names)
        names.remove(cause.effect.name)
        freedom += len(free_coordinates(cause.effect))
        share = (nothing - misfit(state, seen.works)) / possible
        if share >= 1 or _explained(share, freedom, images) < GATE / (TESTS * choices):
            return True
        taken = 1 - _scatter(gains_left(state, gains.effect.name))[0] / max(scatter, 1e-30)
        if _explained(taken, freedom, count) < GATE / (TESTS * choices):
            return True
    state.load(with_gains)
    return False


def _scatter(gains: Tensor) -> tuple[float, int]:
    """(mean square of the known gains about their mean, how many there are)"""
    known = gains[gains != 0]
    return float(known.var(correction=0)) if len(known) > 1 else 0.0, len(known)


def _explained(share: float, freedom: int, images: float) -> float:
    """Chance that ``freedom`` coordinates explain this share of the variance of as many images' values."""
    rest = images - 1 - freedom
    if rest <= 0 or share <= 0:
        return 1.0
    return f_tail(share / max(1 - share, 1e-9) * rest / freedom, freedom, rest)


def _effective_images(seen: Round) -> float:
    """How many images carry the evidence for gains: (sum of energies)^2 over the sum of their squares."""
    energy: dict[int, float] = {}
    for work in seen.works:
        per_image = (work.site.image * work.weight).double().square().sum((-2, -1)).tolist()
        for frame, amount in zip(work.site.frames.tolist(), per_image, strict=True):
            energy[frame] = energy.get(frame, 0.0) + amount
    return sum(energy.values()) ** 2 / max(sum(e * e for e in energy.values()), 1e-30)


def reconsider(state: Search, cause: Cause, before: Saved, seen: Round, kept: bool) -> bool:
    """Whether a rival of the cause named last does better beside the new one: alone, either may stand for both."""
    if not before.causes or cause.effect.scope != "scene" or cause.effect.channel != "lit":
        return False
    now, (earlier, _, _) = state.save(), before.causes[-1]
    if not kept:
        state.load(before)
    left = misfit(state, seen.works)
    better = max(2 * FLOOR_GAIN, SLIGHT * left, 0.0 if kept else PROMISE * 2 * cause.gain)
    for rival in earlier.rivals:
        if rival.effect.name == cause.effect.name:
            continue
        fewer = _freedom(earlier) - _freedom(rival)
        least = left + FOR_FREE * fewer + SLIGHT * left if kept and fewer > FEWER else left - better
        state.load(before)
        state.causes[-1:] = [rival, copy.copy(cause)]
        refine(state, 2, known=False)
        if misfit(state, seen.works) < least:
            rival.rms_before, rival.rms_after = earlier.rms_before, earlier.rms_after
            state.causes[-1].rms_after = state.residual_rms()
            rival.group = [rival.effect.name, *(n for n in earlier.group if n != rival.effect.name)]
            return True
    state.load(now)
    return False


def kept_promise(state: Search, cause: Cause, seen: Round, nothing: float) -> bool:
    """Whether the model with the cause in it fits better by what its linear estimate said."""
    if (cause.effect.channel == "relief" or cause.effect.name in UNDERRATED) and ordinary(cause):
        return False
    if cause.effect.channel in ("albedo", "relief"):  # the rows that are free of the ground do not know them
        return True
    worse = cause.rms_after > WORSE * cause.rms_before
    if cause.effect.displaces and worse:  # it may have moved the images out of the pixels that are compared
        return False
    if cause.effect.channel == "edge":  # judged in pixels that are masked here
        return not worse
    promised = cause.gain if cause.promised is None else cause.promised
    left = misfit(state, seen.works)
    if cause.effect.name in ALSO_STILL:  # of a blur the rows that move between images may show nothing at all
        better = cause.rms_after * WORSE < cause.rms_before
        return nothing > left or (better and left - nothing < SLIGHT * left)
    return nothing - left > PROMISE * 2 * promised


def ordinary(cause: Cause) -> bool:
    """Whether every data set has as much of it."""
    cls, found = type(cause.effect), parameters(cause)
    null = {p.name: p.default for p in cls.parameters}
    return bool(cls.tolerance) and all(
        abs(found[name]["value"] - null[name]) < size for name, size in cls.tolerance.items()
    )


def _freedom(cause: Cause) -> int:
    """Coordinates that the cause's fit was free to move."""
    effect = cause.effect
    seen = cause.image_evidence.frames if cause.image_evidence is not None else 1
    return seen * len([p for p in effect.fitted() if p.name not in effect.held])


__all__ = ["contest", "instead_of_gains", "kept_promise", "ordinary", "reconsider"]
