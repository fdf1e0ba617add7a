"""Forward selection: name the cause that predicts held-out data best, take it into the model, look again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from stages.diagnose.data import Site
from stages.diagnose.looking import Round, look, narrowed
from stages.diagnose.naming import FLOOR_FID, choose
from stages.diagnose.refining import refine
from stages.diagnose.state import Search

REFUSALS = 3
QUIET_GAIN = 6.0  # nats below which an effect, in the look before, is not looked at again
WORSE = 1.02  # growth of the residual that shows a cause to be a mistake


def search(state: Search, most: int, say: Callable[[str], None]) -> Round:
    """Name causes one after the other; returns the last look, at what is left."""
    seen = look(state, state.open_names())
    while len(state.causes) < most:
        cause = choose(state, seen)
        if cause is None:
            return seen
        cause.rms_before = state.residual_rms()
        kept = state.nominal.vector, [s.texture for s in state.sites], [(c, c.effect) for c in state.causes]
        state.causes.append(cause)
        if cause.effect.scope != "site":
            refine(state, 3 if cause.effect.displaces else 2)
        cause.rms_after = state.residual_rms()
        if not cause.rms_after < WORSE * cause.rms_before:
            state.causes.pop()
            state.refused.add(cause.effect.name)
            state.nominal.vector = kept[0]
            for site, texture in zip(state.sites, kept[1], strict=True):
                site.texture = texture
            for known, effect in kept[2]:
                known.effect = effect
            state.fit()
            if len(state.refused) > REFUSALS:
                return seen
            seen.best.pop(cause.effect.name, None)
            seen.images.pop(cause.effect.name, None)
            continue
        say(f"found {cause.effect.name}: gain {cause.gain:.0f} +- {cause.gain_error:.0f} nats")
        if cause.effect.scope == "site":  # the pattern of these sites' albedo was out of everything else already
            seen.pattern = None
            continue
        seen = narrowed(seen, look(state, _restless(state, seen)))
        seen.best.pop(cause.effect.name, None)
        seen.images.pop(cause.effect.name, None)
    return seen


def _restless(state: Search, seen: Round) -> Sequence[str]:
    """Open effects that had anything to say in the look before."""
    quiet = {n for n, e in seen.best.items() if e.gain < QUIET_GAIN and e.fid < FLOOR_FID}
    return [n for n in state.open_names() if n not in quiet]


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
