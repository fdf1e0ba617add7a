"""Forms of displacement: nothing, a constant, an affine map or a smooth field per frame, with or without relief displacement.

Every pixel says, to first order, how far its image lies beside the ground: residual = gradient x displacement. A form is a sum of
polynomials over the scene per frame, and of h tan(emission), so that fitting one is linear least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from stages.diagnose.data.aligned import aligned
from stages.diagnose.data.sites import Site
from stages.diagnose.model.chain import Chain
from stages.diagnose.settings import BROAD, CONTRAST, FIELD_ORDER
from stages.effects.filters import fine, gradients
from stages.effects.relief_displacement import lean
from stages.physics.formation.resampling import displace

TERMS = tuple((i, k - i) for k in range(FIELD_ORDER + 1) for i in range(k + 1))  # powers of x and y


@dataclass(frozen=True)
class Form:
    """``terms`` of the polynomial per frame; ``leaning``: with relief displacement."""

    name: str
    terms: int
    leaning: bool = False


PLAIN = (Form("none", 0), Form("constant", 1), Form("affine", 3), Form("field", len(TERMS)))
LEANING = tuple(
    Form(f"{f.name} and relief displacement" if f.terms else "relief displacement", f.terms, True) for f in PLAIN
)
FORMS = PLAIN + LEANING


@dataclass
class Frame:
    """Where the scene's coordinates of a site start, for the polynomials."""

    centre: tuple[float, float]
    half: float

    def basis(self, site: Site) -> Tensor:
        """(T, H, W): the polynomials at every pixel of a site, which every frame has an amount of in either direction."""
        place, (height, width) = site.place, site.read.shape[-2:]
        y = ((place[0] + torch.arange(height) - self.centre[0]) / self.half)[:, None]
        x = (place[1] + torch.arange(width) - self.centre[1]) / self.half
        return torch.stack([(x**i * y**j).expand(height, width) for i, j in TERMS])


@dataclass
class Matched:
    """One site beside its rendering: products of (gradient x basis) and of the displacement that the residual asks for.

    gram : (n, P, P), score : (n, P) in units of the residual's variance, P = 2 T + 1 (east, south, leaning)
    basis : (T, H, W)
    here : rows and columns of the piece of the site that it is of
    """

    chain: Chain
    gram: Tensor
    score: Tensor
    basis: Tensor
    leaning: tuple[Tensor, Tensor]
    here: tuple[slice, slice]


def match(
    chain: Chain,
    lit: Tensor,
    known: tuple[Tensor, Tensor],
    frame: Frame,
    level: float,
    pieces: int,
    terms: int | None = None,
) -> list[Matched]:
    """The products of a site, whose images are displaced by about ``known`` (n, H, W), in so many pieces a side.

    terms : how many of the basis are asked for, all where None
    """
    site = chain.site
    residual, east, south, weight = asked(chain, lit, known)
    target = residual + east * known[0] + south * known[1]
    fields = frame.basis(site)[:terms]
    leaning = lean(site.observation, level)
    along = (east * leaning[0] + south * leaning[1])[:, None]
    columns = torch.cat([east[:, None] * fields, south[:, None] * fields, along], 1)
    out = []
    for rows, across in _parts(residual.shape[-2], residual.shape[-1], pieces):
        own = columns[:, :, rows, across].flatten(2)
        weighted = own * weight[:, rows, across].flatten(1)[:, None]
        gram = (weighted @ own.transpose(1, 2)).double()
        score = torch.einsum("npx,nx->np", weighted, target[:, rows, across].flatten(1)).double()
        out.append(Matched(chain, gram, score, fields, leaning, (rows, across)))
    return out


def asked(
    chain: Chain, lit: Tensor, known: tuple[Tensor, Tensor], albedo: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of images that are displaced by about ``known``, four (n, H, W): the residual, what a px further east and south adds to it, and the
    inverse of its variance where it counts. What is broad is left out, and images that show little of the rendered contrast do not count.

    albedo : whether what the other images show is left in
    """
    rendered, site = chain.predict(), chain.site
    image, valid = aligned(site.read, site.read_valid, *known, displace)  # only linearised about: a quick one does
    mask = (valid & lit).float()
    image = image if albedo else without_albedo(image, rendered, mask)
    measured, predicted, *slopes = fine(torch.stack([image, rendered, *gradients(rendered)]), mask, BROAD)
    scale = _scale(measured, predicted)
    residual = measured - scale[:, None, None] * predicted
    east, south = (g * scale[:, None, None] for g in slopes)
    variance = residual.square().sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)
    told = (scale > CONTRAST * site.gain.abs()) / variance.clamp(min=1e-20)
    return residual, east, south, mask * told[:, None, None]


def _scale(measured: Tensor, predicted: Tensor) -> Tensor:
    """(n,) by least squares; brighter is brighter."""
    return ((measured * predicted).sum((-2, -1)) / predicted.square().sum((-2, -1)).clamp(min=1e-20)).clamp(min=0)


def without_albedo(image: Tensor, rendered: Tensor, mask: Tensor) -> Tensor:
    """(n, H, W) images of a place without the fine albedo that each other one shows; mask : 1 where an image counts."""
    measured, predicted = fine(torch.stack([image, rendered]), mask, BROAD)
    level = ((image * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)).abs().clamp(min=1e-9)[:, None, None]
    return image - level * of_others((measured - _scale(measured, predicted)[:, None, None] * predicted) / level, mask)


def of_others(relative: Tensor, mask: Tensor) -> Tensor:
    """(n, H, W) what the other images of a place tell of the relative residual (n, H, W) of each: its albedo.

    Where albedo goes with relief (bright rims and floors of craters), it looks like a shift of every image towards its Sun. Best linear
    prediction from the others' mean; mask : (n, H, W) 1 where an image counts.
    """
    variance = (relative.square() * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)
    mean, known = _of_rest(relative, mask / variance.clamp(min=1e-20)[:, None, None])
    seen = mask * (known > 0)
    common = float((seen * relative * mean).sum() / seen.sum().clamp(min=1))  # variance of albedo
    if not common > 0:
        return torch.zeros_like(relative)
    own = (variance - common).clamp(min=0.05 * variance, max=variance).clamp(min=1e-20)
    mean, known = _of_rest(relative, mask / own[:, None, None])
    return mask * mean * common * known / (common * known + 1)


def _of_rest(relative: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Of every image the weighted mean of all others, 0 where there is none, and the sum of their weights, (n, H, W) each."""
    known = weight.sum(0) - weight
    known = torch.where(known > 1e-6 * weight.sum(0), known, 0.0)
    total = (relative * weight).sum(0) - relative * weight
    return torch.where(known > 0, total / known.clamp(min=1e-20), 0.0), known


def _parts(height: int, width: int, pieces: int) -> list[tuple[slice, slice]]:
    def cut(count: int) -> list[slice]:
        edges = [-(-k * count // pieces) for k in range(pieces + 1)]
        return [slice(a, b) for a, b in pairwise(edges)]

    return [(rows, columns) for rows in cut(height) for columns in cut(width)]


def solve(
    sites: Sequence[Matched], form: Form, frames: int, spread: float, share: float | None = None
) -> tuple[Tensor, float]:
    """Coefficients (frames, 2, T) and the share of leaning, or the former beside a given ``share``; ``spread`` px is what is expected of a
    coefficient.
    """
    count = len(TERMS)
    if not sites or not (form.terms or form.leaning):
        return torch.zeros(frames, 2, count, dtype=torch.float64), 0.0
    chosen = torch.tensor([*range(form.terms), *range(count, count + form.terms)], dtype=torch.long)
    every = torch.cat([torch.from_numpy(s.chain.site.frames) for s in sites])
    gram = torch.zeros(frames, 2 * count + 1, 2 * count + 1, dtype=torch.float64)
    gram.index_add_(0, every, torch.cat([s.gram for s in sites]))
    score = torch.zeros(frames, 2 * count + 1, dtype=torch.float64)
    score.index_add_(0, every, torch.cat([s.score for s in sites]))
    # frames have nothing to do with each other but the share
    inner = gram[:, chosen[:, None], chosen] + spread**-2 * torch.eye(len(chosen), dtype=torch.float64)
    border = gram[:, chosen, -1]
    alone, by_share = torch.linalg.solve(inner, torch.stack([score[:, chosen], border], -1)).unbind(-1)
    if share is None:
        share = 0.0
        if form.leaning:
            wanted = score[:, -1].sum() - (border * alone).sum()
            share = float(wanted / (gram[:, -1, -1].sum() + 1e-6 - (border * by_share).sum()))
    out = torch.zeros(frames, 2, count, dtype=torch.float64)
    out[..., : form.terms] = (alone - share * by_share).view(frames, 2, form.terms)
    return out, share


def displacement(site: Matched, coefficients: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """(n, H, W) each, px; coefficients : (frames, 2, T)."""
    own = coefficients[torch.from_numpy(site.chain.site.frames)].float()
    field = torch.einsum("nat,thw->anhw", own, site.basis)
    return field[0] + share * site.leaning[0], field[1] + share * site.leaning[1]
