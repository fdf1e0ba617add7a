"""Whether it is the form of the smooth nominal model that is wrong: another model alone explains more than a cause does."""

from __future__ import annotations

from stages.diagnose.looking import Round, misfit
from stages.diagnose.nominal import load_nominal
from stages.diagnose.state import Cause, Saved, Search

FORMS = ("M2", "hapke")
# What a wrong form looks like: brightness that goes wrong with the angles, or with the image, since each has its own.
LOOKS_LIKE = (
    "image_gain",
    "limb_darkening",
    "macroscopic_roughness",
    "nonlinearity",
    "opposition_surge",
    "phase_slope",
)


def better_form(state: Search, before: Saved, seen: Round, cause: Cause | None) -> str | None:
    """The model that, fitted in the place of the nominal one, leaves less than that with the cause just named; or None.

    cause : None where something is left that nothing explains. A checkpoint is judged as it is. The state stays as it was.
    """
    if state.settled or state.nominal.predictor is not None or (cause and cause.effect.name not in LOOKS_LIKE):
        return None
    now, mine, least = state.save(), state.nominal, misfit(state, seen.works)
    best = None
    for name in FORMS:
        if name != mine.model.name:
            state.load(before)
            state.nominal = load_nominal(None, name, state.units)
            state.fit()
            left = misfit(state, seen.works)
            state.nominal = mine
            if left < least:
                best, least = name, left
    state.load(now)
    return best


__all__ = ["better_form"]
