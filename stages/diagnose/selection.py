"""Forward selection: name the cause that predicts held-out data best, take it into the model, look again."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

from stages.diagnose.columns import free_coordinates
from stages.diagnose.contest import contest, kept_promise, ordinary, reconsider
from stages.diagnose.data import Site
from stages.diagnose.form import simpler_form
from stages.diagnose.gains import instead_of_gains
from stages.diagnose.looking import Round, align, look, misfit, narrowed, quiet
from stages.diagnose.naming import (
    FLOOR_GAIN,
    IMPERFECT,
    choose,
    floor_fid,
    misaligned,
    with_values,
    worth_image,
)
from stages.diagnose.refining import refine
from stages.diagnose.state import Cause, Search

REFUSALS = 3
NEEDLESS = 0.02  # share of a cause's gain that it must still bring when all are named


def search(state: Search, most: int, say: Callable[[str], None]) -> Round:
    """Name causes one after the other, and drop what later ones made needless; returns the last look, at what is left."""
    seen = _name(state, most, say)
    if state.form is not None:
        return seen
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
        cause = contest(state, rivals, seen)
        cause.rms_before, cause.rms_after = rms, state.residual_rms()
        kept = kept_promise(state, cause, seen, nothing)
        swapped = reconsider(state, cause, before, seen, kept)
        if not kept and not swapped:
            state.load(before)
            state.refused.add(cause.effect.name)
            if len(state.refused) > REFUSALS:
                return seen
            seen.best.pop(cause.effect.name, None)
            seen.images.pop(cause.effect.name, None)
            continue
        state.form = simpler_form(state, before, seen, cause)
        if state.form is not None:
            return seen
        if cause.effect.name == "image_gain" and instead_of_gains(state, before, seen, nothing):
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


def _prune(state: Search, seen: Round) -> bool:
    """Drop causes without which the others fit as well, or that have become ordinary: whether any was dropped.

    What is left of a cause must be worth a name of its own: the first of two may have stood for the second until that was known.
    """
    pruned, rows = False, seen.statistics.rows if seen.statistics is not None else 0.0
    for cause in list(state.causes):
        if cause.effect.channel == "relief" and (ordinary(cause) or _faint(cause)):
            if not ordinary(cause):
                state.unsure.add(cause.effect.name)
            state.causes.remove(cause)
            refine(state, 2, known=False)
            pruned = True
        if cause.effect.scope != "scene" or cause.effect.channel != "lit":
            continue
        if cause.effect.name == "saturation":  # the histogram showed it; the pixels that it cuts off are left out here
            continue
        if cause is state.causes[-1] and (len(state.causes) == 1 or not _faint(cause)):
            continue
        if cause.for_gains and any(
            c.effect.name == "image_gain" for c in state.causes
        ):  # that they fit as well is known
            continue
        before, best = state.save(), misfit(state, seen.works)
        state.causes.remove(cause)
        refine(state, 2, known=False)
        cost = misfit(state, seen.works) - best
        least = max(floor_fid(state.data.slope), IMPERFECT * max(c.fid for c in state.causes))
        if cost < max(2 * FLOOR_GAIN, 2 * NEEDLESS * cause.gain, least**2 * rows) or ordinary(cause) or _faint(cause):
            pruned = True
        else:
            state.load(before)
    return pruned


def _faint(cause: Cause) -> bool:
    """Whether no free coordinate is three errors away from doing nothing; what can only have made it smaller is none here."""
    null = cause.effect.null()
    for name in free_coordinates(cause.effect):
        error, lowered = cause.errors.get(name, 0.0), cause.lowered.get(name, 0.0)
        if abs(float(cause.effect.values[name]) - null[name]) >= 3 * math.sqrt(max(error**2 - lowered**2, 0.0)):
            return False
    return True


def _settle_shifts(state: Search) -> None:
    """Shifts that looked large before a further cause was known (jitter has a mean over any crop) may be ordinary now."""
    for cause in [c for c in state.causes if c.effect.name == "misregistration"]:
        e = cause.image_evidence
        if e is not None and len(state.causes) > 1 and not worth_image(with_values(e, cause.effect), 1):
            state.aligned = cause.effect
            state.causes.remove(cause)


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
