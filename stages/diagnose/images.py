"""Evidence for effects with one set of values per image: shifts, jitter, gains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.columns import (
    BASELINE,
    image_columns,
    nominal_columns,
    nuisance_columns,
    tangent_columns,
    trial_columns,
)
from stages.diagnose.numbers import f_tail
from stages.diagnose.preparing import SiteWork
from stages.diagnose.projection import Blocks, Local, cut_out
from stages.diagnose.statistics import BLOCK
from stages.effects import Effect, Survey, get_effect

OVERSHOOT = 1.5  # texture and slopes, known from images that are not aligned yet, hide a third of each shift
PRIORS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # standard deviations over a realistic size
SMALL = PRIORS[:3]  # once most is known: what is hardly seen must not drift
COSTS_NOTHING = 0.005  # of a gain: a prior that costs more shrinks what is known (by the root of it)
COMMON = 0.03  # px, ordinary mean over the images of what they can only have against each other
STEPS = 2  # in which values are found: each leaves of a value what it draws to nothing
FEWEST = 3  # images of a site, below which an image's own fault and the ground's texture are one


@dataclass
class ImageEvidence:
    """values, errors : (frames, K), NaN-free; rms : of the values; together : images of the site that has most.

    known : (frames, K), share of each value that the data fix, the rest being drawn to nothing
    """

    effect: str
    values: Tensor
    errors: Tensor
    rms: float
    rms_error: float
    gain: float
    gain_error: float
    p: float
    fid: float
    frames: int
    together: int
    known: Tensor
    agreement: float = 1.0  # gain of values that hold for all sites over that of values for each


@dataclass
class _Fold:
    gram: Tensor
    score: Tensor


@dataclass
class ImageProducts:
    """What one site says of effects with values per image: per effect, normal equations on two halves of the blocks."""

    frames: NDArray[np.int64]
    rows: float
    folds: dict[str, list[_Fold]]


def gather_images(
    work: SiteWork, names: Sequence[str], dn: bool, data: Survey, held: bool = False
) -> ImageProducts | None:
    """None for sites with too few images. held : scene-wide effects in the model stay as they are, else they may move along"""
    if work.chain.site.count < FEWEST or not names:
        return None
    folds = _site_folds(work, names, dn, [] if held else tangent_columns(work.chain, data)[1], data)
    return ImageProducts(work.chain.site.frames, work.projector.dynamic_rows, folds)


def weigh_images(
    every: Sequence[ImageProducts | None], frames: int, priors: Sequence[float] = PRIORS
) -> dict[str, ImageEvidence]:
    """Evidence for each effect of image scope, from the sites with enough images.

    priors : standard deviations over a realistic size, of which held-out blocks choose
    """
    sums: dict[str, list[_Fold]] = {}
    parts: dict[str, list[tuple[Tensor, _Fold]]] = {}
    deep = [site for site in every if site is not None]
    for site in deep:
        for name, folds in site.folds.items():
            k = len(get_effect(name).fitted())
            place = torch.from_numpy(site.frames)[:, None] * k + torch.arange(k)
            place = place.flatten()
            total = sums.setdefault(
                name,
                [_Fold(torch.zeros(frames * k, frames * k).double(), torch.zeros(frames * k).double()) for _ in folds],
            )
            whole = _Fold(sum(f.gram for f in folds), sum(f.score for f in folds))  # type: ignore[arg-type]
            parts.setdefault(name, []).append((place, whole))
            for into, fold in zip(total, folds, strict=True):
                into.gram[place[:, None], place[None]] += fold.gram
                into.score[place] += fold.score
    rows, together = sum(site.rows for site in deep), max((len(site.frames) for site in deep), default=1)
    found = {name: _weigh(name, folds, frames, rows, together, priors) for name, folds in sums.items()}
    for name, e in found.items():
        e.agreement = _agreement(e.values.flatten().double(), parts[name])
    return found


def _agreement(values: Tensor, parts: list[tuple[Tensor, _Fold]]) -> float:
    """An image's gain is the same wherever it looks; what stands for a misfit of the ground is not."""
    if len(parts) < 3:
        return 1.0
    own = common = 0.0
    for place, fold in parts:
        ridge = max(1e-6 * float(fold.gram.diagonal().mean()), 1e-30) * torch.eye(len(fold.gram), dtype=torch.float64)
        own += 0.5 * float(fold.score @ torch.linalg.solve(fold.gram + ridge, fold.score))
        here = values[place]
        common += float(here @ fold.score - 0.5 * here @ fold.gram @ here)
    chance = 0.5 * (sum(len(place) for place, _ in parts) - len(values))
    return common / max(own - chance, 1e-9)


def _site_folds(
    work: SiteWork, names: Sequence[str], dn: bool, tangents: list[Tensor], data: Survey
) -> dict[str, list[_Fold]]:
    """Per effect, normal equations of its values on two interleaved halves of the blocks, everything else removed."""
    chain, projector = work.chain, work.projector
    fixed = [*nominal_columns(chain), chain.unresolved_slopes(), *tangents]
    for effect in BASELINE:
        if effect not in [e.name for e in chain.base]:
            fixed += trial_columns(chain, effect, get_effect(effect).trials(data)[0], data)
    columns = torch.stack([*fixed, work.residual]) * projector.weight
    on_basis = projector.coefficients(columns)
    projector.project_(columns, on_basis)
    # all columns of single images at once: shifts (and gain and offset), then the effects' own
    base = [e.name for e in chain.base]
    named = {*base, *(e.name for e in chain.moved)}
    groups = {"": nuisance_columns(chain, dn), "brightness": chain.textured[:, None]}
    for name in names:
        place = base.index(name) if name in base else None
        groups[name] = torch.stack(image_columns(chain, get_effect(name), place), 1)
    local = Local(projector, torch.cat(list(groups.values()), 1))
    n, k = local.raw.shape[:2]
    ends = np.cumsum([g.shape[1] for g in groups.values()])
    own = {name: np.arange(end - g.shape[1], end) for (name, g), end in zip(groups.items(), ends, strict=True)}
    folds = []
    for blocks in _halves(*work.residual.shape[-2:]):
        flat = cut_out(columns, blocks).flatten(1)
        cross = local.cross(columns, None, blocks)  # the columns are projected already
        top = torch.cat([(flat @ flat.T).double(), cross.T], 1)
        folds.append(torch.cat([top, torch.cat([cross, local.products(blocks)], 1)]))
    first = len(columns)

    def places(kinds) -> np.ndarray:
        """Rows of the products that belong to these columns, image by image."""
        return (first + np.arange(n)[:, None] * k + np.asarray(kinds, int)).flatten()

    out = {}
    for name in names:
        others = own[""]
        if name == "misregistration":  # what a wrong phase function does to an image's brightness is no shift
            others = np.concatenate([others[2:], own["brightness"]]) if not dn else others[2:]
        elif name in named:
            others = others[: 4 if dn else 2]
        nuisance = np.concatenate([np.arange(first - 1), places(others)])
        wanted = np.concatenate([[first - 1], places(own[name])])
        out[name] = _without(folds, nuisance, wanted)
    return out


def _halves(height: int, width: int) -> tuple[Blocks, Blocks]:
    """A chessboard of blocks: its black ones and its white ones."""
    size = min(BLOCK, max(8, min(height, width) // 4))
    black, white = [], []
    for i in range(-(-height // size)):
        for j in range(-(-width // size)):
            block = slice(i * size, (i + 1) * size), slice(j * size, (j + 1) * size)
            (white if (i + j) % 2 else black).append(block)
    return black, white


def _without(folds: list[Tensor], nuisance: np.ndarray, wanted: np.ndarray) -> list[_Fold]:
    """Products of the wanted columns (the residual first) once the nuisance columns are fitted to all folds together."""
    total = torch.stack(folds).sum(0)
    gram = total[np.ix_(nuisance, nuisance)]
    scale = gram.diagonal().clamp(min=1e-30).rsqrt()
    normal = gram * scale[:, None] * scale + 1e-6 * torch.eye(len(gram), dtype=torch.float64)
    share = torch.linalg.solve(normal, scale[:, None] * total[np.ix_(nuisance, wanted)]) * scale[:, None]
    out = []
    for fold in folds:
        cross = fold[np.ix_(nuisance, wanted)]
        half = cross.T @ share
        left = fold[np.ix_(wanted, wanted)] - half - half.T + share.T @ fold[np.ix_(nuisance, nuisance)] @ share
        out.append(_Fold(left[1:, 1:], left[1:, 0]))
    return out


def _weigh(
    name: str, folds: list[_Fold], frames: int, rows: float, together: int, priors: Sequence[float]
) -> ImageEvidence:
    k = len(get_effect(name).fitted())
    total = _Fold(sum(f.gram for f in folds), sum(f.score for f in folds))  # type: ignore[arg-type]
    seen = total.gram.diagonal().view(frames, k).sum(1) > 0
    count = int(seen.sum())

    cls = get_effect(name)
    ordinary = torch.eye(frames * k, dtype=torch.float64)
    shared = torch.zeros_like(ordinary)
    if cls.relative and count > 1:
        shared = torch.outer(seen.double(), seen.double()) / (COMMON * count) ** 2
        shared = torch.kron(shared, torch.eye(k, dtype=torch.float64))

    def solve(fold: _Fold, penalty: float) -> Tensor:
        return torch.linalg.solve(fold.gram + penalty * ordinary + shared, fold.score)

    # directions that the nominal model can nearly imitate are shrunk as far as held-out blocks ask for
    typical = max(cls.strong.values())
    tried = []
    for level in priors:
        penalty = 1 / (level * typical) ** 2
        gain = 0.0
        for fold, other in ((folds[0], folds[1]), (folds[1], folds[0])):
            guess = solve(other, penalty)
            gain += float(guess @ fold.score - 0.5 * guess @ (fold.gram @ guess))
        tried.append((gain, penalty))
    top = max(g for g, _ in tried)
    # the strictest prior that loses next to nothing: what the nominal model can imitate costs nothing and means nothing
    gain, penalty = next((g, q) for g, q in tried if g >= top - max(COSTS_NOTHING * abs(top), 2.0))
    a, b = solve(folds[0], penalty), solve(folds[1], penalty)
    # the halves are compared in units of what they change in the image, not of the values themselves
    power, axes = torch.linalg.eigh(total.gram)
    root = power.clamp(min=0).sqrt()
    firm = power > 1e-4 * power.max()
    x, y = (root * (axes.T @ a))[firm], (root * (axes.T @ b))[firm]
    r = float(x @ y / (x.square().sum() * y.square().sum()).sqrt().clamp(min=1e-30))
    freedom = max(int(firm.sum()) - 1, 1)
    p = 0.5 * f_tail(r * r / max(1 - r * r, 1e-12) * freedom, 1, freedom) if r > 0 else 1.0
    flat = solve(total, penalty)
    values = flat.view(frames, k)
    variance = torch.linalg.inv(total.gram + penalty * ordinary + shared).diagonal().clamp(min=0)
    errors, known = variance.sqrt().view(frames, k), (1 - penalty * variance).clamp(min=0).view(frames, k)
    values = torch.where(seen[:, None], values, 0.0)
    rms = math.sqrt(float(values[seen].square().sum(1).mean())) if count else 0.0
    uncertain = math.sqrt(float(errors[seen].square().sum(1).mean()) / max(count, 1)) if count else 0.0
    # values along what the nominal model can imitate are not in the data: that many chi squares more or less
    lost = float((penalty / (power.clamp(min=0) + penalty)).pow(STEPS).sum()) - (frames - count) * k
    lost = max(lost - (k if cls.relative else 0), 0.0)
    uncertain = math.hypot(uncertain, rms * math.sqrt(2 * lost) / (2 * max(count * k, 1)))
    return ImageEvidence(
        name, values.float(), errors.float(), rms, uncertain, gain,
        math.sqrt(2 * max(gain, 0.0) + count * k), p,
        math.sqrt(max(float(flat @ total.gram @ flat), 0.0) / max(rows, 1.0)), count, together, torch.where(seen[:, None], known, 0.0),
    )  # fmt: skip


def as_effect(evidence: ImageEvidence, known: Effect | None, data: Survey, share: float = 1.0) -> Effect:
    """The effect with its values per image; ``share`` of the increments is added to values known already."""
    cls = get_effect(evidence.effect)
    values = {}
    for k, parameter in enumerate(cls.fitted()):
        increment = share * evidence.values[:, k]
        values[parameter.name] = increment + known.values[parameter.name] if known is not None else increment
    return cls(values, data)


def spread(values: Tensor, evidence: ImageEvidence | None) -> float:
    """rms length of the values per image (frames, K); the less an image says of its own the less it counts.

    What all images of a site have in common belongs to the ground.
    """
    seen = values.abs().sum(1) > 0
    if not bool(seen.any()):
        return 0.0
    known = torch.ones_like(values) if evidence is None else evidence.known.to(values)
    share = (1 - (1 - known[seen]) ** STEPS).square().mean(1)
    size = float((share * values[seen].square().sum(1)).sum() / share.square().sum().clamp(min=1e-3)) ** 0.5
    together = evidence.together if evidence is not None else 1
    return size * math.sqrt(together / (together - 1)) if together > 1 else size


__all__ = ["FEWEST", "OVERSHOOT", "SMALL", "ImageEvidence", "as_effect", "gather_images", "spread", "weigh_images"]
