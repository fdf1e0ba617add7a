"""What registration found: where the images lie, and how sure one form is over another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.data.sites import Site
from stages.diagnose.likelihood.intervals import chance
from stages.diagnose.model.chain import Chain
from stages.diagnose.registration.forms import Form, Frame
from stages.diagnose.registration.lines import Lines, lines
from stages.diagnose.registration.own import own_fields
from stages.diagnose.registration.start import Field
from stages.diagnose.settings import DISCOVERY
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
    and with what other samples say of a line
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

    @property
    def displaced(self) -> bool:
        """Whether images lie anywhere but where the file says."""
        return self.form.name != "none" or self.lines_tremble

    @property
    def lines_tremble(self) -> bool:
        """Whether lines are surely shifted against each other, and by more than is ordinary."""
        return self.gains["lines"].low > 0 and not self.lines.ordinary

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
    chances = np.array([_chance(b, a) for b, a in zip(before.T, after.T, strict=True)])
    chances = np.where(np.isfinite(chances), chances, 1.0)
    order = np.argsort(chances)
    passed = np.flatnonzero(chances[order] <= DISCOVERY * np.arange(1, len(order) + 1) / len(order))
    return np.sort(order[: passed.max() + 1]) if len(passed) else np.zeros(0, np.int64)


def _chance(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Of such a gain of one frame where there is none."""
    shown = before > 0
    return chance((before - after)[shown], before[shown])


def of_frames(squares: NDArray[np.float64], frames: NDArray[np.int64] | None) -> NDArray[np.float64]:
    """(pieces,) of some frames, or of all."""
    return squares.sum(1) if frames is None else squares[:, frames].sum(1)


__all__ = ["Gain", "Registration", "of_frames", "shifted_frames"]
