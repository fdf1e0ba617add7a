"""Capture where every image lies, then explain it: the form that predicts ground it was not fitted to best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.likelihood.jackknife import gain_chance, gain_interval, jackknife_error, nats
from stages.diagnose.model.aligned import aligned
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import Nominal, lit_mask
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.capture import capture
from stages.diagnose.registration.forms import (
    FORMS,
    TERMS,
    WAVES,
    Form,
    Frame,
    Matched,
    basis,
    displacement,
    match,
    solve,
)
from stages.diagnose.rows.patches import cuts
from stages.diagnose.settings import BROAD, CAPTURE, CORRELATED, FOLDS, SURE
from stages.effects import Effect
from stages.effects.relief_displacement import lean


@dataclass
class Gain:
    """Percent of the held-out squared residual, with its 95 % interval."""

    percent: float = math.nan
    low: float = math.nan
    high: float = math.nan


@dataclass
class Registration:
    """What explains where the images lie.

    coefficients : (frames, 2, T), px; share : of the relief displacement; gains : of each form over nothing
    leaning : of relief displacement beside the same form without; errors of the constants, (frames, 2), px
    """

    form: Form
    coefficients: Tensor
    share: float
    share_error: float
    gains: dict[str, Gain]
    leaning: Gain
    known: list[tuple[Tensor, Tensor]]
    frame: Frame
    level: float
    squares: dict[str, NDArray[np.float64]]
    rms: dict[str, float]
    shift_error: float
    pixels: float
    fitted: dict[str, tuple[Tensor, float]]
    tested: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def test(self, sites: Sequence[Site], nominal: Nominal) -> None:
        """Squares of every form on ground that nothing was fitted to, into ``tested``: relief displacement beside each image's own field."""
        if not sites:
            return
        group = [s.ground for s in sites]
        chains = [nominal.chain(s, []) for s in sites]
        known = [self.at(c) for c in chains]
        matched = _match_all(sites, nominal, [], known, self.frame, self.level, 1)
        fields = {f.name: [displacement(m, *self.fitted[f.name]) for m in matched] for f in FORMS}
        own = {leans: self.settled(sites, nominal, self.share if leans else 0.0) for leans in (False, True)}
        for m, k in zip(matched, range(len(sites)), strict=True):
            every = [*(fields[f.name][k] for f in FORMS), own[False][k], own[True][k]]
            for name, squares in zip([*fields, "own", "own, leaning"], left(m, every), strict=True):
                self.tested.setdefault(name, np.zeros(max(group) + 1))[group[k]] += squares.sum()

    def doubt(self, first: str, second: str, tested: tuple[str, str]) -> str:
        """Why the second form's gain over the first is not sure, with the test pairs' part in it; ''"""
        low, high = gain_interval(self.squares[first], self.squares[second])[1:]
        if not low > 0:
            return f"its held-out gain is {low:.0f} .. {high:.0f} %, which may be nothing"
        if not self.tested:
            return ""
        before, after = (self.tested[t] for t in tested)
        part, low, high = gain_interval(before, after)
        if high < 0 or (math.isnan(high) and after.sum() > before.sum()):
            return f"the test pairs contradict it: it gains {100 * (1 - after.sum() / before.sum()):.0f} % there"
        # what one comparison gains there counts with the rest of the held-out ground
        both = [np.concatenate([self.squares[f], t]) for f, t in ((first, before), (second, after))]
        part, low, high = gain_interval(*both)
        return (
            ""
            if low > 0
            else f"with the test pairs its held-out gain is {part:.0f} % ({low:.0f} .. {high:.0f}), which may be nothing"
        )

    def evidence(self, first: Form, second: Form) -> tuple[float, float, float]:
        """Chance of the second form's gain over the first where there is none, the gain in nats, and its error."""
        before, after = self.squares[first.name], self.squares[second.name]
        gain = self.gain(first, second)
        total = nats(float(before.sum()), float(after.sum()), self.pixels, CORRELATED)
        error = abs(total) * (gain.high - gain.low) / (4 * max(abs(gain.percent), 1e-9))
        return gain_chance(before, after), total, error

    def gain(self, first: Form, second: Form) -> Gain:
        """Of the second form over the first."""
        return Gain(*gain_interval(self.squares[first.name], self.squares[second.name]))

    def at(self, chain: Chain, waves: bool = True) -> tuple[Tensor, Tensor]:
        """Where the form has the images of any site look, (n, H, W) px each; ``waves``: those over the lines with it."""
        site = chain.site
        own = self.coefficients[torch.from_numpy(site.frames)].float()
        if not waves:
            own = own[..., : len(TERMS)]
        field = torch.einsum("nat,thw->anhw", own, basis(self.frame, site)[: own.shape[-1]])
        east, south = lean(site.observation, self.level)
        return field[0] + self.share * east, field[1] + self.share * south

    def settled(self, sites: Sequence[Site], nominal: Nominal, share: float) -> list[tuple[Tensor, Tensor]]:
        """Relief displacement by ``share`` plus each image's own shift and affine map, captured beside it: a nuisance of any comparison."""
        leaning = [tuple(share * d for d in lean(s.observation, self.level)) for s in sites]
        kept = [(s.read, s.read_valid) for s in sites]
        for site, (east, south) in zip(sites, leaning, strict=True):
            site.read, site.read_valid = aligned(site.read, site.read_valid, east, south)
        shifts = captured(sites, nominal, [])
        for site, (image, valid) in zip(sites, kept, strict=True):
            site.read, site.read_valid = image, valid
        none = torch.zeros_like(self.coefficients)
        ends, matched = [], []
        for share_of_shift in (0.0, 1.0):  # the strongest peak of a correlation may be a neighbouring crater
            known = [
                (e + share_of_shift * d[:, :1, None], s + share_of_shift * d[:, 1:, None])
                for (e, s), d in zip(leaning, shifts, strict=True)
            ]
            for _ in range(3):
                matched = _match_all(sites, nominal, [], known, self.frame, self.level, 1)
                known = _own_fields(matched, none, share, 1, 3)
            ends.append(known)
        out = []
        for m, first, second in zip(matched, *ends, strict=True):
            near, far = left(m, [first, second])
            better = torch.from_numpy(far < near)[:, None, None]
            out.append((torch.where(better, second[0], first[0]), torch.where(better, second[1], first[1])))
        return out

    def mean_shifts(self, sites: Sequence[Site], frames: int) -> Tensor:
        """(frames, 2) px east and south: the field of every frame without relief displacement, meaned over what it shows."""
        total, count = torch.zeros(frames, 2), torch.zeros(frames)
        for site in sites:
            own = self.coefficients[torch.from_numpy(site.frames)].float()
            mean = basis(self.frame, site).mean((-2, -1))
            total.index_add_(0, torch.from_numpy(site.frames), own @ mean)
            count.index_add_(0, torch.from_numpy(site.frames), torch.ones(site.count))
        return total / count.clamp(min=1)[:, None]


def captured(sites: Sequence[Site], nominal: Nominal, base: Sequence[Effect]) -> list[Tensor]:
    """(n, 2) shift east and south per site, px: each image's own, where it stands out from what its frame has in common."""

    def of(site: Site) -> tuple[Tensor, Tensor, Tensor]:
        chain = nominal.chain(site, base)
        lit = lit_mask(chain) | (site.read_valid & chain.lit())
        shift, peak = capture(site.read, site.read_valid, chain.predict(), lit, CAPTURE, BROAD)
        _, still = capture(site.read, site.read_valid, chain.predict(), lit, 1, BROAD)
        count = (site.read_valid & lit).sum((-2, -1)).float()
        z = (torch.atanh(peak.clamp(max=0.999)) - torch.atanh(still.clamp(-0.9, 0.999))) * (count / CORRELATED).sqrt()
        border = (shift.abs() > CAPTURE - 0.5).any(1)
        return shift, torch.where(border, 0.0, z), still

    out = []
    for shift, z, still in per_site(of, sites):
        near = shift.abs().amax(1) <= 1.5
        sure = (z > SURE) | (near & (still > 0.3))
        out.append(torch.where(sure[:, None], shift, 0.0))
    return out


def explain(sites: Sequence[Site], nominal: Nominal, base: Sequence[Effect], frames: int, level: float) -> Registration:
    """Capture, fit every form, score each on held-out sites, and align the sites by the best; sites' ``displacement`` is set."""
    shifts = captured(sites, nominal, base)
    known = [
        (d[:, 0, None, None].expand_as(s.image), d[:, 1, None, None].expand_as(s.image))
        for d, s in zip(shifts, sites, strict=True)
    ]
    frame = _frame(sites)
    pieces = cuts(min(sites[0].image.shape[-2:]), len(sites))
    spread = max(float(torch.cat(shifts).square().mean().sqrt()), 0.3)
    matched: list[Matched] = []
    for _ in range(2):
        matched = _match_all(sites, nominal, base, known, frame, level, pieces)
        coefficients, share = solve(matched, FORMS[-1], frames, spread)
        known = _own_fields(matched, coefficients, share, pieces**2)
    matched = _match_all(sites, nominal, base, known, frame, level, pieces)
    squares = _held_out(matched, frames, spread)
    gains = {f.name: Gain(*gain_interval(squares[0], after)) for f, after in zip(FORMS, squares, strict=True)}
    best = _best(squares)
    form = FORMS[best]
    plain, slanted = (FORMS.index(form.beside(leaning=leans)) for leans in (False, True))
    leaning = Gain(*gain_interval(squares[plain], squares[slanted]))
    coefficients, share = solve(matched, form, frames, spread)
    group = _grounds(matched)
    without = [
        solve([m for m, g in zip(matched, group, strict=True) if g != gone], form, frames, spread)[1]
        for gone in sorted(set(group))
    ]
    error = float(jackknife_error(np.array(without)))
    # what nothing explains is left alone: a wrong Sun looks like a shift of its own at every site
    if best:
        known = _own_fields(matched, coefficients, share, pieces**2)
    else:
        known = [displacement(m, coefficients, share) for m in matched[:: pieces**2]]
    pixels = sum(float(s.read_valid.sum()) for s in sites)
    by_name = {f.name: q for f, q in zip(FORMS, squares, strict=True)}
    rms = {k: math.sqrt(float(q.sum()) / max(pixels, 1.0)) for k, q in by_name.items()}
    axis = len(TERMS) + WAVES  # columns of an axis
    shifts = [
        torch.linalg.inv(m.gram[:, [0, axis]][:, :, [0, axis]] / CORRELATED + 1e-9 * torch.eye(2)) for m in matched
    ]
    every = torch.cat([s.diagonal(dim1=1, dim2=2).sum(1) for s in shifts])
    shift_error = math.sqrt(float(every.median()) * frames / max(len(every), 1))
    fitted = {f.name: solve(matched, f, frames, spread) for f in FORMS}
    return Registration(
        form, coefficients, share, error, gains, leaning, known, frame, level, by_name, rms, shift_error, pixels, fitted
    )


def _frame(sites: Sequence[Site]) -> Frame:
    places = torch.tensor([s.place for s in sites])
    size = max(sites[0].image.shape[-2:])
    low, high = places.min(0).values, places.max(0).values + size
    centre = (low + high) / 2
    return Frame((float(centre[0]), float(centre[1])), float((high - low).max()) / 2)


def _match_all(sites, nominal: Nominal, base, known, frame: Frame, level: float, pieces: int) -> list[Matched]:
    def of(k: int) -> list[Matched]:
        chain = nominal.chain(sites[k], base)
        return match(chain, chain.predict(), lit_mask_read(chain), known[k], frame, level, pieces)

    return [m for part in per_site(of, range(len(sites))) for m in part]


def lit_mask_read(chain) -> Tensor:
    site = chain.site
    valid, site.valid = site.valid, torch.ones_like(site.valid)
    lit = lit_mask(chain)
    site.valid = valid
    return lit


def _own_fields(
    matched: Sequence[Matched], coefficients: Tensor, share: float, pieces: int, terms: int = 1
) -> list[tuple[Tensor, Tensor]]:
    """The form's displacement plus each image's own beside it, drawn to nothing as far as it is not known.

    terms : 1 for a shift, 3 for an affine map about the crop's centre; the scatter of either is estimated
    """
    axis = len(TERMS) + WAVES
    place = torch.tensor([*range(terms), *range(axis, axis + terms)])
    degree = torch.tensor([min(k, 1) for k in range(terms)] * 2)
    parts = []
    for k in range(0, len(matched), pieces):
        own_parts = matched[k : k + pieces]
        m = own_parts[0]
        turn = _about_centre(m, terms)
        known = coefficients[torch.from_numpy(m.chain.site.frames)].flatten(1)
        known = torch.cat([known, torch.full((len(known), 1), share, dtype=known.dtype)], 1)
        gram = torch.stack([m.gram for m in own_parts]).sum(0)[:, place] / CORRELATED
        # what the residual still asks for once the form is taken out
        asks = torch.stack([m.score for m in own_parts]).sum(0)[:, place] / CORRELATED
        asks = asks - torch.einsum("nap,np->na", gram, known)
        parts.append((turn.T @ gram[:, :, place] @ turn, asks @ turn, turn, m))
    spread = torch.full((2,), 0.3, dtype=torch.float64)
    for _ in range(6):
        squares, n = torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
        for gram, asks, _, _ in parts:
            inverse = torch.linalg.inv(gram + torch.diag(spread[degree] ** -2))
            own = torch.einsum("nab,nb->na", inverse, asks)
            squares.index_add_(0, degree, (own.square() + inverse.diagonal(dim1=1, dim2=2)).sum(0))
            n.index_add_(0, degree, torch.full((len(degree),), float(len(own)), dtype=torch.float64))
        spread = (squares / n.clamp(min=1)).sqrt().clamp(min=1e-3)
    out = []
    for gram, asks, turn, m in parts:
        own = torch.linalg.solve(gram + torch.diag(spread[degree] ** -2), asks[..., None])[..., 0] @ turn.T
        field = torch.einsum("nat,thw->anhw", own.float().view(len(own), 2, terms), m.basis[:terms])
        east, south = displacement(m, coefficients, share)
        out.append((east + field[0], south + field[1]))
    return out


def _about_centre(m: Matched, terms: int) -> Tensor:
    """(2 terms, 2 terms): polynomials over the scene for 1, and for east and south of the crop's centre over half its side."""
    turn = torch.eye(terms, dtype=torch.float64)
    for k in range(1, terms):
        here = m.basis[k].double()
        half = (here.max() - here.min()).clamp(min=1e-9) / 2
        turn[0, k], turn[k, k] = -here.mean() / half, 1 / half
    return torch.block_diag(turn, turn)


def _held_out(matched: list[Matched], frames: int, spread: float) -> list[NDArray[np.float64]]:
    """Squared residual per site, (sites,) for each form, fitted to other sites."""
    group = _grounds(matched)
    folds = [[k for k, g in enumerate(group) if g % FOLDS == fold] for fold in range(FOLDS)]
    folds = [f for f in folds if f]
    out = [np.zeros(max(group) + 1) for _ in FORMS]
    for fold in folds:
        rest = [m for k, m in enumerate(matched) if k not in fold]
        found = [solve(rest, form, frames, spread) for form in FORMS]
        for k in fold:
            fields = [displacement(matched[k], *f) for f in found]
            for into, squares in zip(out, left(matched[k], fields), strict=True):
                into[group[k]] += squares.sum()
    return out


def _grounds(matched: Sequence[Matched]) -> list[int]:
    """Which pieces are left out together: all that lie on one ground, where there are enough grounds."""
    numbers = sorted({m.chain.site.ground for m in matched})
    return [numbers.index(m.chain.site.ground) if len(numbers) > 3 else k for k, m in enumerate(matched)]


def left(m: Matched, fields) -> list[NDArray[np.float64]]:
    """(n,) sums of squared relative residuals on the pixels that all fields keep, gain and offset per image taken out."""
    chain = m.chain
    predicted, lit = chain.predict(), lit_mask_read(chain)
    moved = [aligned(chain.site.read, chain.site.read_valid, *f) for f in fields]
    mask = lit & torch.stack([v for _, v in moved]).all(0) & (m.part > 0)
    weight = mask.double()
    n = weight.sum((-2, -1)).clamp(min=1)
    level = ((predicted * weight).sum((-2, -1)) / n).clamp(min=1e-9)
    x = (predicted - level[:, None, None]) * weight
    out = []
    for image, _ in moved:
        y = image * weight
        y = (y - (y.sum((-2, -1)) / n)[:, None, None]) * weight
        slope = (x * y).sum((-2, -1)) / x.square().sum((-2, -1)).clamp(min=1e-20)
        kept = y - slope[:, None, None] * x
        out.append((kept.square().sum((-2, -1)) / _norm(chain)).numpy())
    return out


def _norm(chain: Chain) -> Tensor:
    """(n,) squared brightness as measured, so that images of all exposures count alike."""
    mask = chain.site.read_valid.double()
    return ((chain.site.read * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)).square().clamp(min=1e-20)


def _best(squares: list[NDArray[np.float64]]) -> int:
    """The form that leaves least on held-out sites, of those that leave less than nothing does for sure; the first if there is none."""
    sure = [k for k in range(1, len(FORMS)) if gain_interval(squares[0], squares[k])[1] > 0]
    return min(sure, key=lambda k: float(squares[k].sum()), default=0)


__all__ = ["Gain", "Registration", "explain"]
