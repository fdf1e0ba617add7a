"""Capture where every image lies, then explain it: the form that predicts ground it was not fitted to best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.likelihood.jackknife import gain_chance, gain_interval, nats
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import Nominal, lit_mask
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.capture import capture
from stages.diagnose.registration.forms import (
    FORMS,
    TERMS,
    Form,
    Frame,
    Matched,
    aligned,
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

    def at(self, chain: Chain) -> tuple[Tensor, Tensor]:
        """Where the form has the images of any site look, (n, H, W) px each."""
        site = chain.site
        basis = self.frame.basis(site.place, *site.read.shape[-2:])
        own = self.coefficients[torch.from_numpy(site.frames)].float()
        field = torch.einsum("nat,thw->anhw", own, basis)
        east, south = lean(site.observation, self.level)
        return field[0] + self.share * east, field[1] + self.share * south

    def mean_shifts(self, sites: Sequence[Site], frames: int) -> Tensor:
        """(frames, 2) px east and south: the field of every frame without relief displacement, meaned over what it shows."""
        total, count = torch.zeros(frames, 2), torch.zeros(frames)
        for site in sites:
            own = self.coefficients[torch.from_numpy(site.frames)].float()
            basis = self.frame.basis(site.place, *site.read.shape[-2:]).mean((-2, -1))
            total.index_add_(0, torch.from_numpy(site.frames), own @ basis)
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
        known = _own_shifts(matched, [displacement(m, coefficients, share) for m in matched], pieces**2)
    matched = _match_all(sites, nominal, base, known, frame, level, pieces)
    squares = _held_out(matched, frames, spread)
    gains = {f.name: Gain(*gain_interval(squares[0], after)) for f, after in zip(FORMS, squares, strict=True)}
    best = _best(squares)
    plain = next(k for k, f in enumerate(FORMS) if f.terms == FORMS[best].terms and not f.leaning)
    slanted = next(k for k, f in enumerate(FORMS) if f.terms == FORMS[best].terms and f.leaning)
    leaning = Gain(*gain_interval(squares[plain], squares[slanted]))
    form = FORMS[best]
    coefficients, share = solve(matched, form, frames, spread)
    without = [solve([m for m in matched if m is not left], form, frames, spread)[1] for left in matched]
    units = len(matched)
    error = math.sqrt((units - 1) / units * float(np.var(without) * units)) if units > 1 else math.inf
    fields = [displacement(m, coefficients, share) for m in matched]
    # what nothing explains is left alone: a wrong Sun looks like a shift of its own at every site
    known = _own_shifts(matched, fields, pieces**2) if best else fields[:: pieces**2]
    pixels = sum(float(s.read_valid.sum()) for s in sites)
    by_name = {f.name: q for f, q in zip(FORMS, squares, strict=True)}
    rms = {k: math.sqrt(float(q.sum()) / max(pixels, 1.0)) for k, q in by_name.items()}
    shifts = [
        torch.linalg.inv(m.gram[:, [0, len(TERMS)]][:, :, [0, len(TERMS)]] / CORRELATED + 1e-9 * torch.eye(2))
        for m in matched
    ]
    every = torch.cat([s.diagonal(dim1=1, dim2=2).sum(1) for s in shifts])
    shift_error = math.sqrt(float(every.median()) * frames / max(len(every), 1))
    return Registration(
        form, coefficients, share, error, gains, leaning, known, frame, level, by_name, rms, shift_error, pixels
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


def _own_shifts(matched: Sequence[Matched], fields, pieces: int) -> list[tuple[Tensor, Tensor]]:
    """The form's displacement plus each image's own shift beside it, drawn to nothing as far as it is not known."""
    count = len(TERMS)
    place = torch.tensor([0, count])
    parts = []
    fields = fields[::pieces]
    for k, (east, south) in enumerate(fields):
        own_parts = matched[k * pieces : (k + 1) * pieces]
        gram = torch.stack([m.gram for m in own_parts]).sum(0)[:, place[:, None], place] / CORRELATED
        # what the residual still asks for once the form is taken out
        at = torch.stack([east, south], 1).double().mean((-2, -1))
        asks = torch.stack([m.score for m in own_parts]).sum(0)[:, place] / CORRELATED - torch.einsum(
            "nab,nb->na", gram, at
        )
        parts.append((gram, asks))
    spread = 0.3
    for _ in range(6):
        squares, n = 0.0, 0
        for gram, asks in parts:
            normal = gram + torch.eye(2, dtype=torch.float64) / spread**2
            own = torch.linalg.solve(normal, asks[..., None])[..., 0]
            squares += float(own.square().sum() + torch.linalg.inv(normal).diagonal(dim1=1, dim2=2).sum())
            n += own.numel()
        spread = max(math.sqrt(squares / n), 1e-3)
    out = []
    for (gram, asks), (east, south) in zip(parts, fields, strict=True):
        own = torch.linalg.solve(gram + torch.eye(2, dtype=torch.float64) / spread**2, asks[..., None])[..., 0].float()
        out.append((east + own[:, 0, None, None], south + own[:, 1, None, None]))
    return out


def _held_out(matched: list[Matched], frames: int, spread: float) -> list[NDArray[np.float64]]:
    """Squared residual per site, (sites,) for each form, fitted to other sites."""
    numbers = sorted({m.chain.site.number for m in matched})
    group = [numbers.index(m.chain.site.number) if len(numbers) > 3 else k for k, m in enumerate(matched)]
    folds = [[k for k, g in enumerate(group) if g % FOLDS == fold] for fold in range(FOLDS)]
    folds = [f for f in folds if f]
    out = [np.zeros(len(matched)) for _ in FORMS]
    for fold in folds:
        rest = [m for k, m in enumerate(matched) if k not in fold]
        found = [solve(rest, form, frames, spread) for form in FORMS]
        for k in fold:
            fields = [displacement(matched[k], *f) for f in found]
            for into, squares in zip(out, left(matched[k], fields), strict=True):
                into[k] = squares
    return out


def left(m: Matched, fields) -> list[float]:
    """Sum of squared relative residuals on the pixels that all fields keep, gain and offset per image taken out."""
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
        out.append(float((kept.square().sum((-2, -1)) / _norm(chain)).sum()))
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
