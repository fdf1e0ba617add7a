"""Capture where every image lies, then explain it: the form that predicts ground it was not fitted to best."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.data.parallel import per_site
from stages.diagnose.data.sites import Site
from stages.diagnose.likelihood.intervals import gain_interval, jackknife_error
from stages.diagnose.likelihood.patches import cuts
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import Nominal
from stages.diagnose.registration.forms import FORMS, TERMS, Form, Frame, Matched, displacement, solve
from stages.diagnose.registration.lines import STEADY, TREMBLING, Lines, lines
from stages.diagnose.registration.own import beside, match_all, own_fields
from stages.diagnose.registration.registered import Gain, Registration, shifted_frames
from stages.diagnose.registration.squares import OWN, compared, grounds, held_out, shown_once
from stages.diagnose.registration.start import start
from stages.diagnose.settings import CORRELATED, PATCH, SURE
from stages.effects import Effect
from stages.effects.misregistration import ORDINARY as USUAL_SHIFT
from stages.effects.relief_displacement import ORDINARY

HALVES = 2  # pieces a side of crops that frames show one each of: a shift that one quarter has, the others have as well


def explain(sites: Sequence[Site], nominal: Nominal, base: Sequence[Effect], frames: int, level: float) -> Registration:
    """Capture, fit every form, score each on held-out sites; ``known`` is where the images are by the best, each image's own shift beside it."""
    chains = per_site(lambda site: nominal.chain(site, base), sites)
    known, spread = start(chains, frames, level)
    frame = _frame(sites)
    once, size = shown_once(sites), min(sites[0].image.shape[-2:])
    pieces = max(cuts(size, len(sites)), min(HALVES, size // PATCH) if once else 1)
    spread = max(spread, 0.3)
    matched: list[Matched] = []
    for _ in range(2):
        matched = match_all(chains, known, frame, level, pieces)
        coefficients, share = solve(matched, FORMS[-1], frames, spread)
        known = beside(matched, coefficients, share, pieces**2)
    matched = match_all(chains, known, frame, level, pieces)
    group = grounds(matched, once)
    # by the form with most freedom: what else displaces images must not pass for relief
    share = solve(matched, FORMS[-1], frames, spread)[1]
    rest = {g: [m for m, k in zip(matched, group, strict=True) if k != g] for g in sorted(set(group))}
    without = {g: solve(m, FORMS[-1], frames, spread)[1] for g, m in rest.items()}
    error = float(jackknife_error(np.array(list(without.values()))))
    fitted = {f.name: solve(matched, f, frames, spread, share if f.leaning else None) for f in FORMS}
    squares = dict(zip((f.name for f in FORMS), held_out(matched, group, frames, spread), strict=True))
    shares = [without[g] for g in group[:: pieces**2]]
    plain = own_fields(chains, fitted["constant"][0], [0.0] * len(sites), frame, level, 1)
    slanted = own_fields(chains, fitted["constant and relief displacement"][0], shares, frame, level, 1)
    squares |= compared(matched, group, dict(zip(OWN, (plain, slanted), strict=True)), frames, pieces**2)
    gains = {k: Gain(*gain_interval(squares["none"].sum(1), q.sum(1))) for k, q in squares.items() if k in fitted}
    gains["lines"] = Gain(0.0, 0.0, 0.0)
    leaning = Gain(*gain_interval(squares[OWN[0]].sum(1), squares[OWN[1]].sum(1)))
    far = torch.cat([torch.stack(m.leaning).square().sum(0).flatten() for m in matched]).mean().sqrt()
    surely = leaning.low > 0 and abs(share) > SURE * error
    # one crop alone takes a wrong Sun, or relief that is off, for a small shift: as much is left to what explains it
    told = not once or _rms_shift(fitted["constant"][0]) >= USUAL_SHIFT
    form = _best(squares, surely and abs(share) * float(far) > ORDINARY, told)
    form, trembling, beside_lines = _lines(chains, matched, group, fitted, form, frames)
    squares |= beside_lines
    if beside_lines:
        gains["lines"] = Gain(*gain_interval(squares[STEADY].sum(1), squares[TREMBLING].sum(1)))
    coefficients, share = fitted[form.name]
    simple = [f for f in FORMS if f is form or f.terms == 1]
    by_rest = {
        f.name: [solve(m, f, frames, spread, without[g] if f.leaning else None)[0] for g, m in rest.items()]
        for f in simple
    }
    pixels = sum(float(s.read_valid.sum()) for s in sites)
    rms = {k: math.sqrt(float(q.sum()) / max(pixels, 1.0)) for k, q in squares.items()}
    constant = [0, len(TERMS)]
    shifts = [torch.linalg.inv(m.gram[:, constant][:, :, constant] / CORRELATED + 1e-9 * torch.eye(2)) for m in matched]
    every = torch.cat([s.diagonal(dim1=1, dim2=2).sum(1) for s in shifts])
    shift_error = math.sqrt(float(every.median()) * frames / max(len(every), 1))
    found = Registration(
        form, coefficients, share, error, gains, trembling.known, trembling, frame, level, squares, rms, shift_error, pixels,
        fitted, by_rest,
    )  # fmt: skip
    if found.lines_tremble:
        found.known = trembling.fields
    return found


def _lines(
    chains: Sequence[Chain],
    matched: Sequence[Matched],
    group: Sequence[int],
    fitted: Mapping[str, tuple[Tensor, float]],
    form: Form,
    frames: int,
) -> tuple[Form, Lines, dict[str, NDArray[np.float64]]]:
    """How lines tremble beside the form, and the squares without and with that; none where that is ordinary. Where crops have their lines in common
    an affine map or a field has a part of it: a shift per frame takes its place where beside it other samples of a line say more than such a
    form does.
    """
    pieces = len(matched) // len(chains)
    forms = [form, *(f for f in FORMS if f.terms == 1 < form.terms and f.leaning == form.leaning)]
    found: list[Lines] = []
    for each in forms:
        coefficients, share = fitted[each.name]
        # what nothing explains is left alone: a wrong Sun looks like a shift of its own at every site
        if each.terms or each.leaning:
            found.append(lines(chains, beside(matched, coefficients, share, pieces)))
        else:
            found.append(lines(chains, [displacement(m, coefficients, share) for m in matched[::pieces]]))
    if all(each.ordinary for each in found):
        return form, found[0], {}
    fields = {name: x for k, f in enumerate(found) for name, x in ((f"{k} known", f.known), (f"{k} across", f.across))}
    squares = compared(matched, group, fields, frames, pieces)
    best = int(len(found) > 1 and squares["1 across"].sum() < squares["0 known"].sum())
    return forms[best], found[best], {STEADY: squares[f"{best} known"], TREMBLING: squares[f"{best} across"]}


def _rms_shift(coefficients: Tensor) -> float:
    """px, of all frames that lie anywhere else at all. coefficients : (frames, 2, T) of constant displacements"""
    squares = coefficients[:, :, 0].square().sum(1)
    return math.sqrt(float(squares[squares > 0].mean())) if bool((squares > 0).any()) else 0.0


def _frame(sites: Sequence[Site]) -> Frame:
    places = torch.tensor([s.place for s in sites])
    size = max(sites[0].image.shape[-2:])
    low, high = places.min(0).values, places.max(0).values + size
    centre = (low + high) / 2
    return Frame((float(centre[0]), float(centre[1])), float((high - low).max()) / 2)


def _best(squares: dict[str, NDArray[np.float64]], leans: bool, told: bool) -> Form:
    """Of the forms with relief displacement, or of those without, the one that leaves least on held-out ground, of those that leave less than
    nothing does for sure; else a shift of those frames that it surely places better; else the plain one. told : whether frames can be told to lie anywhere else
    """
    plain = next(f for f in FORMS if not f.terms and f.leaning == leans)
    others = [f for f in FORMS if told and f.terms and f.leaning == leans]
    sure = [f for f in others if gain_interval(squares["none"].sum(1), squares[f.name].sum(1))[1] > 0]
    sure = sure or [f for f in others if f.terms == 1 and len(shifted_frames(squares[plain.name], squares[f.name]))]
    return min(sure, key=lambda f: float(squares[f.name].sum()), default=plain)


__all__ = ["explain"]
