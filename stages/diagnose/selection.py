"""Forward selection: name the cause that predicts held-out data best, take it into the model, look again."""

from __future__ import annotations

import copy
from collections.abc import Callable

from stages.diagnose.answer import parameters
from stages.diagnose.columns import free_coordinates
from stages.diagnose.data import Site
from stages.diagnose.looking import Round, align, look, misfit, narrowed, quiet
from stages.diagnose.naming import (
    FLOOR_GAIN,
    GATE,
    IMPERFECT,
    SIMPLER,
    UNDERRATED,
    choose,
    floor_fid,
    misaligned,
    with_values,
    worth_image,
)
from stages.diagnose.numbers import f_tail
from stages.diagnose.refining import refine
from stages.diagnose.state import Cause, Saved, Search
from stages.effects import get_effect

REFUSALS = 3
MUCH = 0.05  # of what it explains: by so much a cause for each image must do better than one for all
FOR_FREE = 2.0  # of the sum of squares, that each coordinate gains by itself (Akaike 1974)
FEWER = 4  # coordinates less, which make up for doing slightly worse
SLIGHT = 0.0005  # of what is left: by so much a simpler cause may do worse
MOVES_SHADOWS = ("sun_elevation", "sun_azimuth")
PAIR = 2  # scene-wide causes that are tried together in the place of gains
WORSE = 1.02  # growth of the residual that shows a cause to be a mistake
NEEDLESS = 0.02  # share of a cause's gain that it must still bring when all are named
PROMISE = 0.15  # share of the foretold gain that a cause must bring once it is in the model ...
ALSO_STILL = ("psf_blur", "echo")  # ... but for these, part of whose gain lies in the maps of the ground


def search(state: Search, most: int, say: Callable[[str], None]) -> Round:
    """Name causes one after the other, and drop what later ones made needless; returns the last look, at what is left."""
    seen = _name(state, most, say)
    return look(state, state.open_names()) if _prune(state, seen) else seen


def _name(state: Search, most: int, say: Callable[[str], None]) -> Round:
    rms_as_read, state.reference = state.residual_rms(), copy.copy(state.nominal)
    shifts = align(state)
    if shifts is not None:
        shifted = misaligned(state, shifts)
        if shifted is not None:
            say(f"found {shifted.effect.name}: gain {shifted.gain:.0f} +- {shifted.gain_error:.0f} nats")
            shifted.rms_before, shifted.rms_after = rms_as_read, state.residual_rms()
            state.causes.append(shifted)
        else:  # ordinary shifts are no part of a gain
            state.reference = copy.copy(state.nominal)
    seen = look(state, state.open_names())
    while len(state.causes) < most:
        rivals = choose(state, seen)
        if not rivals:
            return seen
        before, rms, nothing = state.save(), state.residual_rms(), misfit(state, seen.works)
        cause = _contest(state, rivals, seen)
        cause.rms_before, cause.rms_after = rms, state.residual_rms()
        kept = _kept_promise(state, cause, seen, nothing)
        swapped = _reconsider(state, cause, before, seen, kept)
        if not kept and not swapped:
            state.load(before)
            state.refused.add(cause.effect.name)
            if len(state.refused) > REFUSALS:
                return seen
            seen.best.pop(cause.effect.name, None)
            seen.images.pop(cause.effect.name, None)
            continue
        if cause.effect.name == "image_gain" and _instead_of_gains(state, before, seen, nothing):
            cause = state.causes[-1]
        say(f"found {cause.effect.name}: gain {cause.gain:.0f} +- {cause.gain_error:.0f} nats")
        _settle_shifts(state)
        if cause.effect.scope == "site":  # the pattern of these sites' albedo was out of everything else already
            seen.pattern = None
            continue
        silent = {} if swapped else quiet(seen, cause.effect.name)
        seen = narrowed(seen, look(state, [n for n in state.open_names() if n not in silent]), silent)
        for name in {*seen.best, *seen.images} - set(state.open_names()):
            seen.best.pop(name, None)
            seen.images.pop(name, None)
    return seen


def _reconsider(state: Search, cause: Cause, before: Saved, seen: Round, kept: bool) -> bool:
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


def _prune(state: Search, seen: Round) -> bool:
    """Drop causes without which the others fit as well, or that have become ordinary: whether any was dropped.

    What is left of a cause must be worth a name of its own: the first of two may have stood for the second until that was known.
    """
    pruned, rows = False, seen.statistics.rows if seen.statistics is not None else 0.0
    for cause in list(state.causes):
        if cause.effect.scope != "scene" or cause.effect.channel != "lit":
            continue
        if cause is state.causes[-1] and (len(state.causes) == 1 or not _faint(cause)):
            continue
        before, best = state.save(), misfit(state, seen.works)
        state.causes.remove(cause)
        refine(state, 2, known=False)
        cost = misfit(state, seen.works) - best
        least = max(floor_fid(state.data.slope), IMPERFECT * max(c.fid for c in state.causes))
        if cost < max(2 * FLOOR_GAIN, 2 * NEEDLESS * cause.gain, least**2 * rows) or _ordinary(cause) or _faint(cause):
            pruned = True
        else:
            state.load(before)
    return pruned


def _ordinary(cause: Cause) -> bool:
    """Whether every data set has as much of it."""
    cls, found = type(cause.effect), parameters(cause)
    null = {p.name: p.default for p in cls.parameters}
    return bool(cls.tolerance) and all(
        abs(found[name]["value"] - null[name]) < size for name, size in cls.tolerance.items()
    )


def _faint(cause: Cause) -> bool:
    """Whether no free coordinate is three errors away from doing nothing."""
    null = cause.effect.null()
    return all(
        abs(float(cause.effect.values[name]) - null[name]) < 3 * cause.errors.get(name, 0.0)
        for name in free_coordinates(cause.effect)
    )


def _settle_shifts(state: Search) -> None:
    """Shifts that looked large before a further cause was known (jitter has a mean over any crop) may be ordinary now."""
    for cause in [c for c in state.causes if c.effect.name == "misregistration"]:
        e = cause.image_evidence
        if e is not None and len(state.causes) > 1 and not worth_image(with_values(e, cause.effect), 1):
            state.aligned = cause.effect
            state.causes.remove(cause)


def _instead_of_gains(state: Search, before: Saved, seen: Round, nothing: float) -> bool:
    """Gains of images can stand for any scene-wide causes that act by image; whether such causes, up to two, do as well.

    A few numbers for all images against one for each: an F test over the images of what the gains gain. The state holds
    the scene-wide causes afterwards if so (true gains may then come on top), and the gains if not.
    """
    gains, with_gains, rms = state.causes[-1], state.save(), state.residual_rms()
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
        cause = _contest(state, rivals, seen)
        cause.rms_before, cause.rms_after = gains.rms_before, rms
        _reconsider(state, cause, known, seen, kept=True)
        choices *= len(names)
        names.remove(cause.effect.name)
        freedom += len(free_coordinates(cause.effect))
        share = (nothing - misfit(state, seen.works)) / possible
        rest = images - 1 - freedom
        if share >= 1 or (rest > 0 and f_tail(share / (1 - share) * rest / freedom, freedom, rest) < GATE / choices):
            return True
    state.load(with_gains)
    return False


def _effective_images(seen: Round) -> float:
    """How many images carry the evidence for gains: (sum of energies)^2 over the sum of their squares."""
    energy: dict[int, float] = {}
    for work in seen.works:
        per_image = (work.site.image * work.weight).double().square().sum((-2, -1)).tolist()
        for frame, amount in zip(work.site.frames.tolist(), per_image, strict=True):
            energy[frame] = energy.get(frame, 0.0) + amount
    return sum(energy.values()) ** 2 / max(sum(e * e for e in energy.values()), 1e-30)


def _kept_promise(state: Search, cause: Cause, seen: Round, nothing: float) -> bool:
    """Whether the model with the cause in it fits better by what its linear estimate said."""
    if cause.effect.channel in ("albedo", "relief"):  # the rows that are free of the ground do not know them
        return True
    if cause.effect.name in UNDERRATED and _ordinary(cause):
        return False
    worse = cause.rms_after > WORSE * cause.rms_before
    if cause.effect.displaces and worse:  # it may have moved the images out of the pixels that are compared
        return False
    if cause.effect.channel == "edge":  # judged in pixels that are masked here
        return not worse
    promised = cause.gain if cause.promised is None else cause.promised
    return nothing - misfit(state, seen.works) > (0.0 if cause.effect.name in ALSO_STILL else PROMISE * 2 * promised)


def _contest(state: Search, rivals: list[Cause], seen: Round) -> Cause:
    """Take the cause into the model that leaves least once everything is fitted again; the state holds it afterwards.

    Where a wrong Sun is among them shadow edges have a say: it moves them, a bent response does not.
    """
    if len(rivals) == 1:
        state.causes.append(rivals[0])
        if rivals[0].effect.scope != "site":
            refine(state, 3 if rivals[0].effect.displaces else 2)
        return rivals[0]
    per_image = [k for k, c in enumerate(rivals) if c.effect.scope == "image"]  # free to follow any junk at the edges
    moves = any(c.effect.name in MOVES_SHADOWS for c in rivals) and not per_image
    works = seen.edges if moves else seen.works
    before, nothing = state.save(), misfit(state, works, moves)
    tried: list[tuple[float, int, Saved]] = []
    for cause in rivals:
        state.load(before)
        state.causes.append(cause)
        refine(state, 2 if cause.effect.displaces else 1)
        tried.append((nothing - misfit(state, works, moves), _freedom(cause), state.save()))
    if per_image and len(per_image) < len(rivals):  # a number for each image must do much better than one for all
        alone = max(tried[k][0] for k in range(len(rivals)) if k not in per_image)
        single = max(tried[k][0] - FOR_FREE * tried[k][1] for k in per_image)
        drop = alone > (1 - MUCH) * single
        keep = [k for k in range(len(rivals)) if (k in per_image) != drop]
        rivals, tried = [rivals[k] for k in keep], [tried[k] for k in keep]
    most = max(worth for worth, _, _ in tried)
    # a superset of another effect always does a little better; where much is explained, a little is much
    least = most - min((1 - SIMPLER) * abs(most), SLIGHT * max(nothing - most, 0.0))
    place = min(
        (k for k, (worth, _, _) in enumerate(tried) if worth >= least),
        key=lambda k: (tried[k][1], -tried[k][0]),
        default=0,
    )
    cause = rivals[place]
    cause.rivals = [c for c in rivals if c is not cause and c.effect.scope == "scene"]
    state.load(tried[place][2])
    refine(state, 1)
    names = [c.effect.name for c in rivals if c is not cause]
    cause.group = [
        cause.effect.name,
        *(n for n in cause.group[1:] if n in names),
        *(n for n in cause.group[1:] if n not in names),
    ]
    return cause


def _freedom(cause: Cause) -> int:
    """Coordinates that the cause's fit was free to move."""
    effect = cause.effect
    seen = cause.image_evidence.frames if cause.image_evidence is not None else 1
    return seen * len([p for p in effect.fitted() if p.name not in effect.held])


def enough(sites: list[Site]) -> str:
    """Why nothing can be concluded from these data; empty where something can."""
    pixels = sum(int(s.valid.sum()) for s in sites)
    images = sum(s.count for s in sites)
    if pixels < 20_000:
        return f"{pixels} valid pixels are too few to conclude anything (20000 are the least)"
    if images < 4 or max((s.count for s in sites), default=0) < 1:
        return f"{images} images are too few to conclude anything (4 are the least)"
    return ""


__all__ = ["enough", "search"]
