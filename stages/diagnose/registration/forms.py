"""Forms of displacement: nothing, a constant, an affine map or a smooth field per frame, with or without relief displacement.

Every pixel says, to first order, how far its image lies beside the ground: residual = gradient x displacement. A form is a sum of
polynomials over the scene per frame and of h tan(emission), so that fitting one is linear least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.diagnose.model.aligned import aligned
from stages.diagnose.model.chain import Chain
from stages.diagnose.registration.capture import fine
from stages.diagnose.settings import BROAD, FIELD_ORDER
from stages.effects.filters import gradients
from stages.effects.relief_displacement import lean

TERMS = tuple((i, k - i) for k in range(FIELD_ORDER + 1) for i in range(k + 1))  # powers of x and y


@dataclass(frozen=True)
class Form:
    """``terms`` of the polynomial per frame; ``leaning``: with relief displacement."""

    name: str
    terms: int
    leaning: bool = False


FORMS = (
    Form("none", 0),
    Form("constant", 1),
    Form("affine", 3),
    Form("field", len(TERMS)),
    Form("leaning", 0, True),
    Form("constant, leaning", 1, True),
    Form("affine, leaning", 3, True),
    Form("field, leaning", len(TERMS), True),
)


@dataclass
class Frame:
    """Where the scene's coordinates of a site start, for the polynomials."""

    centre: tuple[float, float]
    half: float

    def basis(self, place: tuple[float, float], height: int, width: int) -> Tensor:
        """(T, H, W): the polynomials at every pixel of a crop at ``place``."""
        y = ((place[0] + torch.arange(height) - self.centre[0]) / self.half)[:, None]
        x = (place[1] + torch.arange(width) - self.centre[1]) / self.half
        return torch.stack([(x**i * y**j).expand(height, width) for i, j in TERMS])


@dataclass
class Matched:
    """One site beside its rendering: products of (gradient x basis) and of the displacement that the residual asks for.

    gram : (n, P, P), score : (n, P) in units of the residual's variance, P = 2 T + 1 (east, south, leaning)
    part : (H, W) float, the piece of the site that it is of
    """

    chain: Chain
    gram: Tensor
    score: Tensor
    basis: Tensor
    leaning: tuple[Tensor, Tensor]
    part: Tensor


def match(
    chain: Chain, rendered: Tensor, lit: Tensor, known: tuple[Tensor, Tensor], frame: Frame, level: float, pieces: int
) -> list[Matched]:
    """The products of a site, whose images are displaced by about ``known`` (n, H, W), in so many pieces a side."""
    site = chain.site
    image, valid = aligned(site.read, site.read_valid, *known)
    mask = (valid & lit).float()
    measured, predicted = fine(image, mask, BROAD), fine(rendered, mask, BROAD)
    scale = (measured * predicted).sum((-2, -1)) / predicted.square().sum((-2, -1)).clamp(min=1e-20)
    residual = measured - scale[:, None, None] * predicted
    east, south = (fine(g, mask, BROAD) * scale[:, None, None] for g in gradients(rendered))
    variance = residual.square().sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)
    weight = mask / variance.clamp(min=1e-20)[:, None, None]
    target = residual + east * known[0] + south * known[1]
    basis = frame.basis(site.place, *image.shape[-2:])
    leaning = lean(site.observation, level)
    columns = torch.cat(
        [
            east[:, None] * basis,
            south[:, None] * basis,
            (east * leaning[0] + south * leaning[1])[:, None],
        ],
        1,
    ).flatten(2)
    out = []
    for part in _parts(image.shape[-2], image.shape[-1], pieces):
        weighted = columns * (weight * part).flatten(1)[:, None]
        gram = (weighted @ columns.transpose(1, 2)).double()
        score = torch.einsum("npx,nx->np", weighted, target.flatten(1)).double()
        out.append(Matched(chain, gram, score, basis, leaning, part))
    return out


def _parts(height: int, width: int, pieces: int) -> list[Tensor]:
    row = torch.arange(height)[:, None] * pieces // height
    column = torch.arange(width) * pieces // width
    return [((row == i) & (column == j)).float() for i in range(pieces) for j in range(pieces)]


def solve(sites: Sequence[Matched], form: Form, frames: int, spread: float) -> tuple[Tensor, float]:
    """Coefficients (frames, 2, T) and the share of leaning; ``spread`` px is what is expected of a coefficient."""
    t, count = form.terms, len(TERMS)
    if not sites or not (t or form.leaning):
        return torch.zeros(frames, 2, count, dtype=torch.float64), 0.0
    chosen = torch.tensor([*range(t), *range(count, count + t)], dtype=torch.long)
    size = 2 * t
    total = torch.zeros(frames * size + 1, frames * size + 1, dtype=torch.float64)
    score = torch.zeros(len(total), dtype=torch.float64)
    for site in sites:
        for k, f in enumerate(site.chain.site.frames.tolist()):
            place = torch.cat([f * size + torch.arange(size), torch.tensor([len(total) - 1])])
            own = torch.cat([chosen, torch.tensor([2 * count])])
            total[place[:, None], place] += site.gram[k][own[:, None], own]
            score[place] += site.score[k][own]
    if not form.leaning:
        total[-1], total[:, -1], total[-1, -1], score[-1] = 0.0, 0.0, 1.0, 0.0
    prior = torch.full((len(total),), spread**-2, dtype=torch.float64)
    prior[-1] = 1e-6
    found = torch.linalg.solve(total + torch.diag(prior), score)
    out = torch.zeros(frames, 2, count, dtype=torch.float64)
    out[..., :t] = found[:-1].view(frames, 2, t)
    return out, float(found[-1])


def displacement(site: Matched, coefficients: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """(n, H, W) each, px."""
    own = coefficients[torch.from_numpy(site.chain.site.frames)].float()
    field = torch.einsum("nat,thw->anhw", own, site.basis)
    return field[0] + share * site.leaning[0], field[1] + share * site.leaning[1]
