"""What registration found, as claims: relief displacement, shifts of images, and lines that tremble."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.judge.claim import Rival
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.intervals import jackknife_error
from stages.diagnose.registration.forms import FORMS
from stages.diagnose.registration.lines import STEADY, TREMBLING
from stages.diagnose.registration.registered import Registration, of_frames, shifted_frames
from stages.diagnose.registration.squares import OWN
from stages.diagnose.sources.measured import Measured, measured
from stages.effects import Effect, effect_names, get_effect


def by_registration(state: State) -> list[Measured]:
    """Every effect that displaces images, by the forms that the registration compared."""
    r = state.registration
    if r is None or not r.displaced:
        return []
    classes = [c for c in map(get_effect, effect_names()) if c.displaces and c.judged_apart]
    return [
        made
        for cls in classes
        if (made := (_leaning if cls.leans else _lines if cls.along_lines else _shifts)(state, r, cls))
    ]


def _compared(
    effect: Effect, r: Registration, size: tuple[float, float], parameters: dict[str, tuple[float, float]],
    forms: tuple[str, str], frames: NDArray[np.int64] | None = None, rivals: Sequence[Rival] = (),
) -> Measured:  # fmt: skip
    """The claim of the second form over the first, of some frames or all. size : rms, px, and its error"""
    before, after = (of_frames(r.squares[name], frames) for name in forms)
    every = r.squares[forms[0]]
    pixels = r.pixels * float(before.sum()) / max(float(every.sum()), 1e-30)
    made = measured(effect, ("rms_px", *size), parameters, before, after, pixels, values=2, rivals=rivals)
    share = float(before.sum() / every.sum())  # of the squared residual of all images
    made.named.percent = tuple(share * g for g in made.named.percent)  # type: ignore[assignment]
    return made


def _leaning(state: State, r: Registration, cls: type[Effect]) -> Measured | None:
    lean = state.data.lean_px
    if not r.form.leaning or not lean > 0:
        return None
    size, error = abs(r.share) * lean, r.share_error * lean
    made = _compared(
        cls({"share": r.share}, state.data),
        r,
        (size, error),
        {"share": (r.share, r.share_error), "rms_px": (size, error)},
        OWN,
    )
    return made


def _lines(state: State, r: Registration, cls: type[Effect]) -> Measured | None:
    if not r.lines_tremble:
        return None
    amounts = r.lines.over_the_crop(state.sites, state.frames)
    effect = cls({p.name: amounts[:, k] for k, p in enumerate(cls.fitted())}, state.data)
    size = r.lines.rms, r.lines.error
    return _compared(effect, r, size, {"rms_px": size}, (STEADY, TREMBLING))


def _shifts(state: State, r: Registration, cls: type[Effect]) -> Measured | None:
    """One shift per frame, of all frames, or of those that it surely places better."""
    if not r.form.terms:
        return None
    plain, form = (next(f.name for f in FORMS if f.terms == n and f.leaning == r.form.leaning) for n in (0, 1))

    def of(form: str, frames: NDArray[np.int64] | None) -> Measured:
        def made(coefficients: Tensor) -> Effect:
            shifts = r.mean_shifts(state.sites, coefficients)
            if frames is not None:
                shifts[np.setdiff1d(np.arange(state.frames), frames)] = 0.0
            return cls({"east_px": shifts[:, 0], "south_px": shifts[:, 1]}, state.data)

        effect = made(r.fitted[form][0])
        size = cls.size(effect.values)
        scatter = float(jackknife_error(np.array([cls.size(made(c).values) for c in r.without[form]])))
        known = size, max(scatter, r.shift_error)
        rivals = []
        if not r.form.leaning:  # what leans by its height, sure or not, may explain it
            leaning = next(f.name for f in FORMS if f.terms == 0 and f.leaning)
            shown = of_frames(r.squares[plain], frames) > 0
            gains = of_frames(r.squares[plain], frames) - of_frames(r.squares[leaning], frames)
            rivals = [Rival(leaning, gains[shown], 1)]
        return _compared(effect, r, known, {"rms_px": known}, (plain, form), frames, rivals)

    some = shifted_frames(r.squares[plain], r.squares[form])
    claims = [of(form, None), *([of(form, some)] if len(some) else [])]
    # of a form with more terms a shift is part of what displaces a frame
    if r.form.terms > 1 and len(some := shifted_frames(r.squares[plain], r.squares[r.form.name])):
        claims.append(of(r.form.name, some))
    return next((claim for claim in claims if claim.decide() is None), claims[0])


__all__ = ["by_registration"]
