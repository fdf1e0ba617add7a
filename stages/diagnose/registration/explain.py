"""Capture where every image lies, then explain it: the form that predicts ground it was not fitted to best."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from stages.diagnose.likelihood.jackknife import gain_interval, jackknife_error
from stages.diagnose.model.nominal import Nominal
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.forms import FORMS, TERMS, WAVES, Form, Frame, Matched, displacement, solve
from stages.diagnose.registration.own import beside, match_all, own_fields
from stages.diagnose.registration.registered import Gain, Registration, shifted_frames
from stages.diagnose.registration.squares import OWN, grounds, held_out, held_out_beside_own
from stages.diagnose.registration.start import start
from stages.diagnose.rows.patches import cuts
from stages.diagnose.settings import CORRELATED, SURE
from stages.effects import Effect
from stages.effects.relief_displacement import ORDINARY


def explain(sites: Sequence[Site], nominal: Nominal, base: Sequence[Effect], frames: int, level: float) -> Registration:
    """Capture, fit every form, score each on held-out sites; ``known`` is where the images are by the best, each image's own shift beside it."""
    chains = per_site(lambda site: nominal.chain(site, base), sites)
    known, spread = start(chains, frames, level)
    frame = _frame(sites)
    pieces = cuts(min(sites[0].image.shape[-2:]), len(sites))
    spread = max(spread, 0.3)
    matched: list[Matched] = []
    for _ in range(2):
        matched = match_all(chains, known, frame, level, pieces)
        coefficients, share = solve(matched, FORMS[-1], frames, spread)
        known = beside(matched, coefficients, share, pieces**2)
    matched = match_all(chains, known, frame, level, pieces)
    group = grounds(matched)
    # by the form with most freedom: what else displaces images must not pass for relief
    share = solve(matched, FORMS[-1], frames, spread)[1]
    rest = {g: [m for m, k in zip(matched, group, strict=True) if k != g] for g in sorted(set(group))}
    without = {g: solve(m, FORMS[-1], frames, spread)[1] for g, m in rest.items()}
    error = float(jackknife_error(np.array(list(without.values()))))
    fitted = {f.name: solve(matched, f, frames, spread, share if f.leaning else None) for f in FORMS}
    squares = dict(zip((f.name for f in FORMS), held_out(matched, group, frames, spread), strict=True))
    shares = [without[g] for g in group[:: pieces**2]]
    plain = own_fields(chains, fitted["constant"][0], [0.0] * len(sites), frame, level, 1)
    slanted = own_fields(chains, fitted["constant, leaning"][0], shares, frame, level, 1)
    squares |= held_out_beside_own(matched, group, [plain, slanted], frames, pieces**2)
    gains = {k: Gain(*gain_interval(squares["none"].sum(1), q.sum(1))) for k, q in squares.items() if k in fitted}
    leaning = Gain(*gain_interval(squares[OWN[0]].sum(1), squares[OWN[1]].sum(1)))
    far = torch.cat([torch.stack(m.leaning).square().sum(0).flatten() for m in matched]).mean().sqrt()
    surely = leaning.low > 0 and abs(share) > SURE * error
    form = _best(squares, surely and abs(share) * float(far) > ORDINARY)
    coefficients, share = fitted[form.name]
    told = [f for f in FORMS if f is form or f.terms == 1]
    by_rest = {
        f.name: [solve(m, f, frames, spread, without[g] if f.leaning else None)[0] for g, m in rest.items()]
        for f in told
    }
    # what nothing explains is left alone: a wrong Sun looks like a shift of its own at every site
    if form.terms or form.leaning:
        known = beside(matched, coefficients, share, pieces**2)
    else:
        known = [displacement(m, coefficients, share) for m in matched[:: pieces**2]]
    pixels = sum(float(s.read_valid.sum()) for s in sites)
    rms = {k: math.sqrt(float(q.sum()) / max(pixels, 1.0)) for k, q in squares.items()}
    axis = len(TERMS) + WAVES  # columns of an axis
    shifts = [
        torch.linalg.inv(m.gram[:, [0, axis]][:, :, [0, axis]] / CORRELATED + 1e-9 * torch.eye(2)) for m in matched
    ]
    every = torch.cat([s.diagonal(dim1=1, dim2=2).sum(1) for s in shifts])
    shift_error = math.sqrt(float(every.median()) * frames / max(len(every), 1))
    return Registration(
        form, coefficients, share, error, gains, known, frame, level, squares, rms, shift_error, pixels, fitted, by_rest
    )


def _frame(sites: Sequence[Site]) -> Frame:
    places = torch.tensor([s.place for s in sites])
    size = max(sites[0].image.shape[-2:])
    low, high = places.min(0).values, places.max(0).values + size
    centre = (low + high) / 2
    return Frame((float(centre[0]), float(centre[1])), float((high - low).max()) / 2)


def _best(squares: dict[str, NDArray[np.float64]], leans: bool) -> Form:
    """Of the forms with relief displacement, or of those without, the one that leaves least on held-out ground, of those that leave less than
    nothing does for sure; else a shift of those frames that it surely places better; else the plain one.
    """
    plain = next(f for f in FORMS if not f.terms and f.leaning == leans)
    others = [f for f in FORMS if f.terms and f.leaning == leans]
    sure = [f for f in others if gain_interval(squares["none"].sum(1), squares[f.name].sum(1))[1] > 0]
    sure = sure or [f for f in others if f.terms == 1 and len(shifted_frames(squares[plain.name], squares[f.name]))]
    return min(sure, key=lambda f: float(squares[f.name].sum()), default=plain)


__all__ = ["explain"]
