"""Capture where every image lies, then explain it: the form that predicts ground it was not fitted to best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby

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
from stages.diagnose.registration.start import Field, captured, laid, start
from stages.diagnose.rows.patches import cuts
from stages.diagnose.settings import CORRELATED, DISCOVERY, FOLDS, SURE
from stages.effects import Effect
from stages.effects.relief_displacement import ORDINARY, lean

OWN = "own", "own, leaning"  # each image's own shift, without and with relief displacement


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
    fitted : coefficients and share of every form; without : coefficients by all ground but one piece, of the form and of constant ones
    squares : of the residual, (pieces of ground, frames) for every form, and in OWN without and with relief displacement; tested : of the test pairs
    """

    form: Form
    coefficients: Tensor
    share: float
    share_error: float
    gains: dict[str, Gain]
    known: list[tuple[Tensor, Tensor]]
    frame: Frame
    level: float
    squares: dict[str, NDArray[np.float64]]  # (pieces of ground, frames)
    rms: dict[str, float]
    shift_error: float
    pixels: float
    fitted: dict[str, tuple[Tensor, float]]
    without: dict[str, list[Tensor]]
    tested: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def test(self, sites: Sequence[Site], nominal: Nominal) -> None:
        """Squares of every form on ground that nothing was fitted to, into ``tested``: relief displacement beside each image's own field."""
        if not sites:
            return
        group = [s.ground for s in sites]
        chains = [nominal.chain(s, []) for s in sites]
        known = [self.at(c) for c in chains]
        matched = _match_all(chains, known, self.frame, self.level, 1)
        fields = {f.name: [displacement(m, *self.fitted[f.name]) for m in matched] for f in FORMS}
        own = {leans: self.settled(chains, self.share if leans else 0.0, 1) for leans in (False, True)}
        for m, k in zip(matched, range(len(sites)), strict=True):
            every = [*(fields[f.name][k] for f in FORMS), own[False][k], own[True][k]]
            for name, (squares,) in zip([*fields, *OWN], left([m], every), strict=True):
                total = self.tested.setdefault(name, np.zeros((max(group) + 1, len(self.coefficients))))
                np.add.at(total[group[k]], m.chain.site.frames, squares)

    def doubt(self, first: str, second: str, tested: tuple[str, str], frames: NDArray[np.int64] | None = None) -> str:
        """Why the second form's gain over the first is not sure, with the test pairs' part in it; ''. frames : that count, all where None"""
        learned = _shown(*(_of(self.squares[name], frames) for name in (first, second)))
        low, high = gain_interval(*learned)[1:]
        if not low > 0:
            return f"its held-out gain is {low:.0f} .. {high:.0f} %, which may be nothing"
        if not self.tested:
            return ""
        before, after = _shown(*(_of(self.tested[t], frames) for t in tested))
        if not before.sum() > 0:
            return ""
        part, low, high = gain_interval(before, after)
        if high < 0 or (math.isnan(high) and after.sum() > before.sum()):
            return f"the test pairs contradict it: it gains {100 * (1 - after.sum() / before.sum()):.0f} % there"
        # what one comparison gains there counts with the rest of the held-out ground
        both = [np.concatenate(pair) for pair in zip(learned, (before, after), strict=True)]
        part, low, high = gain_interval(*both)
        return (
            ""
            if low > 0
            else f"with the test pairs its held-out gain is {part:.0f} % ({low:.0f} .. {high:.0f}), which may be nothing"
        )

    def evidence(self, first: str, second: str, frames: NDArray[np.int64] | None = None) -> tuple[float, float, float]:
        """Chance of the second form's gain over the first where there is none, the gain in nats, and its error."""
        before, after = _shown(_of(self.squares[first], frames), _of(self.squares[second], frames))
        gain = Gain(*gain_interval(before, after))
        pixels = self.pixels * float(before.sum()) / float(self.squares[first].sum())
        total = nats(float(before.sum()), float(after.sum()), pixels, CORRELATED)
        error = abs(total) * (gain.high - gain.low) / (4 * max(abs(gain.percent), 1e-9))
        return gain_chance(before, after), total, error

    def gain(self, first: str, second: str, frames: NDArray[np.int64] | None = None) -> Gain:
        """Of the second form over the first, as a share of the squared residual of all images."""
        before, after = _shown(_of(self.squares[first], frames), _of(self.squares[second], frames))
        share = float(before.sum() / self.squares[first].sum())
        return Gain(*(share * g for g in gain_interval(before, after)))

    def at(self, chain: Chain, waves: bool = True) -> tuple[Tensor, Tensor]:
        """Where the form has the images of any site look, (n, H, W) px each; ``waves``: those over the lines with it."""
        site = chain.site
        own = self.coefficients[torch.from_numpy(site.frames)].float()
        if not waves:
            own = own[..., : len(TERMS)]
        field = torch.einsum("nat,thw->anhw", own, basis(self.frame, site)[: own.shape[-1]])
        east, south = lean(site.observation, self.level)
        return field[0] + self.share * east, field[1] + self.share * south

    def mean_shifts(self, sites: Sequence[Site], coefficients: Tensor) -> Tensor:
        """(frames, 2) px east and south: of a form's polynomial over the places that show each frame. coefficients : (frames, 2, T)"""
        coefficients = coefficients[..., : len(TERMS)]
        total, count = torch.zeros(coefficients.shape[:2], dtype=torch.float64), torch.zeros(len(coefficients))
        for site in sites:
            frames = torch.from_numpy(site.frames)
            here = basis(self.frame, site)[: len(TERMS)].double().mean((-2, -1))
            total.index_add_(0, frames, coefficients[frames] @ here)
            count.index_add_(0, frames, torch.ones(len(frames)))
        return (total / count.clamp(min=1)[:, None]).float()

    def settled(self, chains: Sequence[Chain], share: float, terms: int = 3) -> list[Field]:
        """Relief displacement by ``share`` plus each image's own shift and affine map, captured beside it: a nuisance of any comparison."""
        shifts, _ = self.fitted["constant, leaning" if share else "constant"]
        return own_fields(chains, shifts, [share] * len(chains), self.frame, self.level, terms)


def explain(sites: Sequence[Site], nominal: Nominal, base: Sequence[Effect], frames: int, level: float) -> Registration:
    """Capture, fit every form, score each on held-out sites; ``known`` is where the images are by the best, each image's own shift beside it."""
    chains = per_site(lambda site: nominal.chain(site, base), sites)
    known, spread = start(chains, frames, level)
    frame = _frame(sites)
    pieces = cuts(min(sites[0].image.shape[-2:]), len(sites))
    spread = max(spread, 0.3)
    matched: list[Matched] = []
    for _ in range(2):
        matched = _match_all(chains, known, frame, level, pieces)
        coefficients, share = solve(matched, FORMS[-1], frames, spread)
        known = _own_fields(matched, coefficients, share, pieces**2)
    matched = _match_all(chains, known, frame, level, pieces)
    group = _grounds(matched)
    # by the form with most freedom: what else displaces images must not pass for relief
    share = solve(matched, FORMS[-1], frames, spread)[1]
    rest = {g: [m for m, k in zip(matched, group, strict=True) if k != g] for g in sorted(set(group))}
    without = {g: solve(m, FORMS[-1], frames, spread)[1] for g, m in rest.items()}
    error = float(jackknife_error(np.array(list(without.values()))))
    fitted = {f.name: solve(matched, f, frames, spread, share if f.leaning else None) for f in FORMS}
    squares = dict(zip((f.name for f in FORMS), _held_out(matched, group, frames, spread), strict=True))
    shares = [without[g] for g in group[:: pieces**2]]
    plain = own_fields(chains, fitted["constant"][0], [0.0] * len(sites), frame, level, 1)
    slanted = own_fields(chains, fitted["constant, leaning"][0], shares, frame, level, 1)
    squares |= _beside_own(matched, group, [plain, slanted], frames, pieces**2)
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
        known = _own_fields(matched, coefficients, share, pieces**2)
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


def _beside_own(
    matched: Sequence[Matched], group: Sequence[int], fields: Sequence[Sequence[Field]], frames: int, pieces: int
) -> dict[str, NDArray[np.float64]]:
    """Squares (pieces of ground, frames) without and with relief displacement, its share by other ground, beside each image's own shift.

    Unlike a form of the whole scene such shifts need no other ground to be known.
    """
    out = {name: np.zeros((max(group) + 1, frames)) for name in OWN}
    for site, own in enumerate(zip(*fields, strict=True)):
        of = slice(site * pieces, (site + 1) * pieces)
        for name, every in zip(OWN, left(matched[of], own), strict=True):
            for g, squares in zip(group[of], every, strict=True):
                np.add.at(out[name][g], matched[of.start].chain.site.frames, squares)
    return out


def own_fields(
    chains: Sequence[Chain],
    shifts: Tensor,
    shares: Sequence[float],
    frame: Frame,
    level: float,
    terms: int,
) -> list[Field]:
    """Relief displacement by a share at each site plus each image's own shift (``terms`` 1) or affine map (3), captured beside it and the
    ``shifts`` (frames, 2, T) of frames.
    """
    sites = [c.site for c in chains]
    starts: list[list[Field]] = []
    # the strongest peak of a correlation may be a neighbouring crater, and the shift of a frame one of another part of the scene
    for own_share, of_frame in ((0.0, 1.0), (1.0, 1.0), (1.0, 0.0)):
        known = []
        for site, share in zip(sites, shares, strict=True):
            moved = of_frame * shifts[torch.from_numpy(site.frames), :, 0].float()[..., None, None]
            east, south = lean(site.observation, level)
            known.append((share * east + moved[:, 0], share * south + moved[:, 1]))
        if own_share:
            with laid(sites, known):
                own = captured(chains)
            known = [(e + d[:, :1, None], s + d[:, 1:, None]) for (e, s), d in zip(known, own, strict=True)]
        if not any(_near(known, other) for other in starts):  # they would end at the same place
            starts.append(known)
    ends = []
    matched: list[Matched] = []
    none = torch.zeros(len(shifts), 2, terms, dtype=shifts.dtype)
    for known in starts:
        for _ in range(3):
            matched = _match_all(chains, known, frame, level, 1, terms)
            known = _own_fields(matched, none, shares, 1, terms)
        ends.append(known)
    out = []
    for k, m in enumerate(matched):
        every = [end[k] for end in ends]
        best = torch.from_numpy(np.argmin([squares for (squares,) in left([m], every)], 0))
        n = torch.arange(len(best))
        east, south = (torch.stack([field[axis] for field in every])[best, n] for axis in (0, 1))
        out.append((east, south))
    return out


def _near(first: Sequence[Field], second: Sequence[Field]) -> bool:
    """Whether displacements differ by half a pixel at most."""
    pairs = [(a, b) for f, s in zip(first, second, strict=True) for a, b in zip(f, s, strict=True)]
    return all(float((a - b).abs().max()) <= 0.5 for a, b in pairs)


def _frame(sites: Sequence[Site]) -> Frame:
    places = torch.tensor([s.place for s in sites])
    size = max(sites[0].image.shape[-2:])
    low, high = places.min(0).values, places.max(0).values + size
    centre = (low + high) / 2
    return Frame((float(centre[0]), float(centre[1])), float((high - low).max()) / 2)


def _match_all(
    chains: Sequence[Chain],
    known: Sequence[Field],
    frame: Frame,
    level: float,
    pieces: int,
    terms: int | None = None,
) -> list[Matched]:
    def of(k: int) -> list[Matched]:
        return match(chains[k], lit_mask_read(chains[k]), known[k], frame, level, pieces, terms)

    return [m for part in per_site(of, range(len(chains))) for m in part]


def lit_mask_read(chain) -> Tensor:
    site = chain.site
    valid, site.valid = site.valid, torch.ones_like(site.valid)
    lit = lit_mask(chain)
    site.valid = valid
    return lit


def _own_fields(
    matched: Sequence[Matched], coefficients: Tensor, share: float | Sequence[float], pieces: int, terms: int = 1
) -> list[Field]:
    """The form's displacement plus each image's own beside it, drawn to nothing as far as it is not known.

    share : of relief displacement, or one per site
    terms : 1 for a shift, 3 for an affine map about the crop's centre; the scatter of either is estimated
    """
    axis = len(matched[0].basis)
    place = torch.tensor([*range(terms), *range(axis, axis + terms)])
    degree = torch.tensor([min(k, 1) for k in range(terms)] * 2)
    parts = []
    number = len(matched) // pieces
    shares = [share] * number if isinstance(share, float) else list(share)
    for k, site_share in enumerate(shares):
        own_parts = matched[k * pieces : (k + 1) * pieces]
        m = own_parts[0]
        turn = _about_centre(m, terms)
        known = coefficients[torch.from_numpy(m.chain.site.frames)].flatten(1)
        known = torch.cat([known, torch.full((len(known), 1), site_share, dtype=known.dtype)], 1)
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
    for (gram, asks, turn, m), site_share in zip(parts, shares, strict=True):
        own = torch.linalg.solve(gram + torch.diag(spread[degree] ** -2), asks[..., None])[..., 0] @ turn.T
        field = torch.einsum("nat,thw->anhw", own.float().view(len(own), 2, terms), m.basis[:terms])
        east, south = displacement(m, coefficients, site_share)
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


def _held_out(matched: list[Matched], group: Sequence[int], frames: int, spread: float) -> list[NDArray[np.float64]]:
    """Squared residual per piece of ground and frame, (pieces, frames) for each form, fitted to other ground."""
    folds = [[k for k, g in enumerate(group) if g % FOLDS == fold] for fold in range(FOLDS)]
    folds = [f for f in folds if f]
    out = [np.zeros((max(group) + 1, frames)) for _ in FORMS]

    def of(fold: list[int]) -> list[tuple[list[int], list[list[NDArray[np.float64]]]]]:
        rest = [m for k, m in enumerate(matched) if k not in fold]
        share = solve(rest, FORMS[-1], frames, spread)[1]
        found = [solve(rest, form, frames, spread, share if form.leaning else None) for form in FORMS]
        sites = [list(own) for _, own in groupby(fold, lambda k: id(matched[k].chain))]
        fields = [[displacement(matched[own[0]], *f) for f in found] for own in sites]
        return [(own, left([matched[k] for k in own], f)) for own, f in zip(sites, fields, strict=True)]

    for places, forms in (site for fold in per_site(of, folds) for site in fold):
        for into, every in zip(out, forms, strict=True):
            for k, squares in zip(places, every, strict=True):
                np.add.at(into[group[k]], matched[k].chain.site.frames, squares)
    return out


def shifted_frames(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.int64]:
    """Frames whose squares (pieces of ground, frames) surely get smaller on the ground that shows them; false ones are as rare as the
    false discovery rate has it (Benjamini & Hochberg 1995).
    """
    chance = np.array([gain_chance(*_shown(b, a)) for b, a in zip(before.T, after.T, strict=True)])
    chance = np.where(np.isfinite(chance), chance, 1.0)
    order = np.argsort(chance)
    passed = np.flatnonzero(chance[order] <= DISCOVERY * np.arange(1, len(order) + 1) / len(order))
    return np.sort(order[: passed.max() + 1]) if len(passed) else np.zeros(0, np.int64)


def _of(squares: NDArray[np.float64], frames: NDArray[np.int64] | None) -> NDArray[np.float64]:
    """(pieces,) of some frames, or of all."""
    return squares.sum(1) if frames is None else squares[:, frames].sum(1)


def _shown(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of the pieces of ground that show anything."""
    return before[before > 0], after[before > 0]


def _grounds(matched: Sequence[Matched]) -> list[int]:
    """Which pieces are left out together: all that lie on one ground, where there are enough grounds."""
    numbers = sorted({m.chain.site.ground for m in matched})
    return [numbers.index(m.chain.site.ground) if len(numbers) > 3 else k for k, m in enumerate(matched)]


def left(parts: Sequence[Matched], fields: Sequence[Field]) -> list[list[NDArray[np.float64]]]:
    """Of every field, for every part of one site: (n,) sums of squared relative residuals on the pixels that all fields keep, gain and offset
    per image and part taken out.
    """
    chain = parts[0].chain
    predicted, lit = chain.predict(), lit_mask_read(chain)
    moved = [aligned(chain.site.read, chain.site.read_valid, *f) for f in fields]
    kept = lit & torch.stack([v for _, v in moved]).all(0)

    def of(image: Tensor, m: Matched) -> NDArray[np.float64]:
        rows, columns = m.here
        weight = kept[:, rows, columns].double()
        n = weight.sum((-2, -1), keepdim=True).clamp(min=1)

        def varied(x: Tensor) -> Tensor:
            x = x[:, rows, columns] * weight
            return (x - x.sum((-2, -1), keepdim=True) / n) * weight

        x, y = varied(predicted), varied(image)
        slope = (x * y).sum((-2, -1), keepdim=True) / x.square().sum((-2, -1), keepdim=True).clamp(min=1e-20)
        rest = y - slope.clamp(min=0) * x  # brighter is brighter
        return (rest.square().sum((-2, -1)) / _norm(chain)).numpy()

    return [[of(image, m) for m in parts] for image, _ in moved]


def _norm(chain: Chain) -> Tensor:
    """(n,) squared brightness as measured, so that images of all exposures count alike."""
    mask = chain.site.read_valid.double()
    return ((chain.site.read * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)).square().clamp(min=1e-20)


def _best(squares: dict[str, NDArray[np.float64]], leans: bool) -> Form:
    """Of the forms with relief displacement, or of those without, the one that leaves least on held-out ground, of those that leave less than
    nothing does for sure; else a shift of those frames that it surely places better; else the plain one.
    """
    plain = next(f for f in FORMS if not f.terms and f.leaning == leans)
    others = [f for f in FORMS if f.terms and f.leaning == leans]
    sure = [f for f in others if gain_interval(squares["none"].sum(1), squares[f.name].sum(1))[1] > 0]
    sure = sure or [f for f in others if f.terms == 1 and len(shifted_frames(squares[plain.name], squares[f.name]))]
    return min(sure, key=lambda f: float(squares[f.name].sum()), default=plain)


__all__ = ["Gain", "Registration", "explain"]
