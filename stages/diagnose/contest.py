"""Candidates taken into the model in turn: which of them deserves the name, and whether it keeps what it promised."""

from __future__ import annotations

import copy

from stages.diagnose.answer import parameters
from stages.diagnose.looking import Round, misfit
from stages.diagnose.naming import FLOOR_GAIN, MOVES_SHADOWS, SIMPLER, UNDERRATED
from stages.diagnose.refining import refine
from stages.diagnose.state import Cause, Saved, Search

MUCH = 0.05  # of what it explains: by so much a cause for each image must do better than one for all
FOR_FREE = 2.0  # of the sum of squares, that each coordinate gains by itself (Akaike 1974)
FEWER = 4  # coordinates less, which make up for doing slightly worse
SLIGHT = 0.0005  # of what is left: by so much a simpler cause may do worse
WORSE = 1.02  # growth of the residual that shows a cause to be a mistake
PROMISE = 0.15  # share of the foretold gain that a cause must bring once it is in the model ...
ALSO_STILL = ("psf_blur", "echo")  # ... but for these, part of whose gain lies in the maps of the ground
ENOUGH_IMAGES = 10  # of a site: with fewer the nominal model's freedom can imitate most of what the dynamic rows keep


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
    # what lost for its further coordinates alone is not told apart
    better = [c.effect.name for c, (worth, _, _) in zip(rivals, tried, strict=True) if worth > tried[place][0]]
    cause.group = [
        cause.effect.name,
        *(n for n in dict.fromkeys(better) if n != cause.effect.name and n not in cause.group),
        *(n for n in cause.group[1:] if n in names),
        *(n for n in cause.group[1:] if n not in names),
    ]
    return cause


def _left(state: Search, seen: Round, edges: bool) -> float:
    """Sum of squares that the model leaves, with the pixels about shadow edges or without."""
    return misfit(state, seen.edges if edges else seen.works, edges)


def reconsider(state: Search, cause: Cause, before: Saved, seen: Round, kept: bool) -> bool:
    """Whether a rival of the cause named last does better beside the new one: alone, either may stand for both."""
    if not before.causes or cause.effect.scope != "scene" or cause.effect.channel != "lit":
        return False
    now, (earlier, *_) = state.save(), before.causes[-1]
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
    better = cause.rms_after * WORSE < cause.rms_before
    if cause.effect.name in ALSO_STILL:  # of a blur the rows that move between images may show nothing at all
        return nothing > left or (better and left - nothing < SLIGHT * left)
    if better and state.deepest < ENOUGH_IMAGES and nothing - left > 2 * FLOOR_GAIN:
        return True
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


__all__ = ["contest", "kept_promise", "ordinary", "reconsider"]
