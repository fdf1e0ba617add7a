"""What registration found: where the images lie, and how sure one form is over another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.likelihood.jackknife import gain_chance, gain_interval, nats
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import Nominal
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.forms import FORMS, Form, Frame, displacement
from stages.diagnose.registration.lines import STEADY, TREMBLING, Lines, lines
from stages.diagnose.registration.own import match_all, own_fields
from stages.diagnose.registration.squares import OWN, left
from stages.diagnose.registration.start import Field
from stages.diagnose.settings import CORRELATED, DISCOVERY
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

    lines : of each image against each other, beside ``known``
    coefficients : (frames, 2, T), px; share : of the relief displacement; gains : of each form over nothing
    fitted : coefficients and share of every form; without : coefficients by all ground but one piece, of the form and of constant ones
    squares : of the residual, (pieces of ground, frames) for every form, in OWN without and with relief displacement, in STEADY and TREMBLING without
    and with what other samples say of a line; tested : of the test pairs
    """

    form: Form
    coefficients: Tensor
    share: float
    share_error: float
    gains: dict[str, Gain]
    known: list[Field]
    lines: Lines
    frame: Frame
    level: float
    squares: dict[str, NDArray[np.float64]]  # (pieces of ground, frames)
    rms: dict[str, float]
    shift_error: float
    pixels: float
    fitted: dict[str, tuple[Tensor, float]]
    without: dict[str, list[Tensor]]
    tested: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    @property
    def displaced(self) -> bool:
        """Whether images lie anywhere but where the file says."""
        return self.form.name != "none" or self.lines_tremble

    @property
    def lines_tremble(self) -> bool:
        """Whether lines are surely shifted against each other, and by more than is ordinary."""
        return self.gains["lines"].low > 0 and not self.lines.ordinary

    def test(self, sites: Sequence[Site], nominal: Nominal) -> None:
        """Squares of every form on ground that nothing was fitted to, into ``tested``: relief displacement beside each image's own field."""
        if not sites:
            return
        chains = [nominal.chain(s, []) for s in sites]
        known = [self.at(c) for c in chains]
        matched = match_all(chains, known, self.frame, self.level, 1)
        fields = {f.name: [displacement(m, *self.fitted[f.name]) for m in matched] for f in FORMS}
        fields |= {n: self.settled(chains, share, 1) for n, share in zip(OWN, (0.0, self.share), strict=True)}
        if self.lines_tremble:
            fields[STEADY] = fields[OWN[self.form.leaning]]
            fields[TREMBLING] = lines(chains, fields[STEADY], self.lines.variance).across
        for k, m in enumerate(matched):
            for name, (squares,) in zip(fields, left([m], [f[k] for f in fields.values()]), strict=True):
                total = self.tested.setdefault(name, np.zeros((len(sites), len(self.coefficients))))
                np.add.at(total[k], m.chain.site.frames, squares)

    def doubt(self, first: str, second: str, tested: tuple[str, str], frames: NDArray[np.int64] | None = None) -> str:
        """Why the second form's gain over the first is not sure, with the test pairs' part in it; ''. frames : that count, all where None"""
        learned = shown(*(of_frames(self.squares[name], frames) for name in (first, second)))
        low, high = gain_interval(*learned)[1:]
        if not low > 0:
            return f"no sure gain on held-out ground (95 %: {low:.0f} .. {high:.0f} %)"
        if not self.tested:
            return ""
        before, after = shown(*(of_frames(self.tested[t], frames) for t in tested))
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
            else f"no sure gain on held-out ground once the test pairs count as well ({part:.0f} %; 95 %: {low:.0f} .. {high:.0f})"
        )

    def evidence(self, first: str, second: str, frames: NDArray[np.int64] | None = None) -> tuple[float, float, float]:
        """Chance of the second form's gain over the first where there is none, the gain in nats, and its error."""
        before, after = shown(of_frames(self.squares[first], frames), of_frames(self.squares[second], frames))
        gain = Gain(*gain_interval(before, after))
        pixels = self.pixels * float(before.sum()) / float(self.squares[first].sum())
        total = nats(float(before.sum()), float(after.sum()), pixels, CORRELATED)
        error = abs(total) * (gain.high - gain.low) / (4 * max(abs(gain.percent), 1e-9))
        return gain_chance(before, after), total, error

    def gain(self, first: str, second: str, frames: NDArray[np.int64] | None = None) -> Gain:
        """Of the second form over the first, as a share of the squared residual of all images."""
        before, after = shown(of_frames(self.squares[first], frames), of_frames(self.squares[second], frames))
        share = float(before.sum() / self.squares[first].sum())
        return Gain(*(share * g for g in gain_interval(before, after)))

    def at(self, chain: Chain) -> Field:
        """Where the form has the images of any site look, (n, H, W) px each."""
        site = chain.site
        own = self.coefficients[torch.from_numpy(site.frames)].float()
        field = torch.einsum("nat,thw->anhw", own, self.frame.basis(site))
        east, south = lean(site.observation, self.level)
        return field[0] + self.share * east, field[1] + self.share * south

    def mean_shifts(self, sites: Sequence[Site], coefficients: Tensor) -> Tensor:
        """(frames, 2) px east and south: of a form's polynomial over the places that show each frame. coefficients : (frames, 2, T)"""
        total, count = torch.zeros(coefficients.shape[:2], dtype=torch.float64), torch.zeros(len(coefficients))
        for site in sites:
            frames = torch.from_numpy(site.frames)
            here = self.frame.basis(site).double().mean((-2, -1))
            total.index_add_(0, frames, coefficients[frames] @ here)
            count.index_add_(0, frames, torch.ones(len(frames)))
        return (total / count.clamp(min=1)[:, None]).float()

    def settled(self, chains: Sequence[Chain], share: float, terms: int = 3) -> list[Field]:
        """Relief displacement by ``share`` plus each image's own shift and affine map, captured beside it: a nuisance of any comparison."""
        shifts, _ = self.fitted["constant and relief displacement" if share else "constant"]
        return own_fields(chains, shifts, [share] * len(chains), self.frame, self.level, terms)

    def beside_lines(self, chains: Sequence[Chain], fields: list[Field]) -> list[Field]:
        """Displacements of sites that nothing was fitted to, with what other samples of their images say of a line where lines tremble."""
        return lines(chains, fields, self.lines.variance).across if self.lines_tremble else fields


def shifted_frames(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.int64]:
    """Frames whose squares (pieces of ground, frames) surely get smaller on the ground that shows them; false ones are as rare as the
    false discovery rate has it (Benjamini & Hochberg 1995).
    """
    chance = np.array([gain_chance(*shown(b, a)) for b, a in zip(before.T, after.T, strict=True)])
    chance = np.where(np.isfinite(chance), chance, 1.0)
    order = np.argsort(chance)
    passed = np.flatnonzero(chance[order] <= DISCOVERY * np.arange(1, len(order) + 1) / len(order))
    return np.sort(order[: passed.max() + 1]) if len(passed) else np.zeros(0, np.int64)


def of_frames(squares: NDArray[np.float64], frames: NDArray[np.int64] | None) -> NDArray[np.float64]:
    """(pieces,) of some frames, or of all."""
    return squares.sum(1) if frames is None else squares[:, frames].sum(1)


def shown(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of the pieces of ground that show anything."""
    return before[before > 0], after[before > 0]


__all__ = ["Gain", "Registration", "shifted_frames"]
