"""Evidence for effects with one set of values per image: shifts, jitter, gains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.diagnose.numbers import f_tail
from stages.diagnose.projection import Rows
from stages.diagnose.statistics import (
    BLOCK,
    SiteWork,
    _site_columns,
    _without,
    image_columns,
    nuisance_columns,
    trial_columns,
)
from stages.effects import Effect, Survey, get_effect

FEWEST = 3  # images of a site, below which an image's own fault and the ground's texture are one


@dataclass
class ImageEvidence:
    """values, errors : (frames, K), NaN-free; rms : of the values beyond their errors, by two independent halves."""

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


@dataclass
class _Fold:
    gram: Tensor
    score: Tensor


def weigh_images(
    works: Sequence[SiteWork], names: Sequence[str], frames: int, dn: bool, data: Survey
) -> dict[str, ImageEvidence]:
    """Evidence for each effect of image scope, from the sites with enough images."""
    sums: dict[str, list[_Fold]] = {}
    rows = 0.0
    for work in works:
        if work.chain.site.count < FEWEST:
            continue
        rows += work.projector.dynamic_rows
        for name, folds in _site_folds(work, names, dn, data).items():
            k = len(get_effect(name).fitted())
            place = torch.from_numpy(work.chain.site.frames)[:, None] * k + torch.arange(k)
            place = place.flatten()
            total = sums.setdefault(
                name,
                [_Fold(torch.zeros(frames * k, frames * k).double(), torch.zeros(frames * k).double()) for _ in folds],
            )
            for into, fold in zip(total, folds, strict=True):
                into.gram[place[:, None], place[None]] += fold.gram
                into.score[place] += fold.score
    return {name: _weigh(name, folds, frames, rows) for name, folds in sums.items()}


def _site_folds(work: SiteWork, names: Sequence[str], dn: bool, data: Survey) -> dict[str, list[_Fold]]:
    """Per effect, normal equations of its values on two interleaved halves of the blocks, everything else removed."""
    chain = work.chain
    fixed = list(_site_columns(chain)) + [chain.unresolved_slopes()]
    for effect in ("psf_blur", "dem_smoothing"):
        fixed += trial_columns(chain, effect, get_effect(effect).trials(data)[0], data)
    common = work.projector.rows(torch.stack(fixed))
    y = _without(common, work.raw_rows)
    shifts = nuisance_columns(chain, dn)
    out = {}
    base = [e.name for e in chain.base]
    for name in names:
        place = base.index(name) if name in base else None
        own = torch.stack(image_columns(chain, get_effect(name), place), 1)
        others = shifts[:, 2:] if name == "misregistration" else shifts
        if name in base and name != "misregistration":
            others = shifts[:, : 4 if dn else 2]
        z = _without(common, _spread(work, own))
        if others.shape[1]:
            z = _without(_without(common, _spread(work, others)), z)
            left = _without(_without(common, _spread(work, others)), y)
        else:
            left = y
        out[name] = _fold_up(z, left)
    return out


def _spread(work: SiteWork, columns: Tensor) -> Rows:
    """Columns (n, k, H, W) of single images -> rows of n k columns, each zero in the other images before projection."""
    n, k, height, width = columns.shape
    wide = torch.zeros(n * k, n, height, width)
    for i in range(n):
        wide[i * k : (i + 1) * k, i] = columns[i]
    return work.projector.rows(wide)


def _fold_up(z: Rows, y: Rows) -> list[_Fold]:
    height, width = y.dynamic.shape[-2:]
    size = min(BLOCK, max(8, min(height, width) // 4))
    parity = (torch.arange(height)[:, None] // size + torch.arange(width) // size) % 2
    folds = []
    for half in (0, 1):
        mask = parity == half
        zd, zs = z.dynamic[..., mask].flatten(1), z.static[..., mask].flatten(1)
        yd, ys = y.dynamic[0][..., mask].flatten(), y.static[0][..., mask].flatten()
        folds.append(_Fold((zd @ zd.T + zs @ zs.T).double(), (zd @ yd + zs @ ys).double()))
    return folds


def _weigh(name: str, folds: list[_Fold], frames: int, rows: float) -> ImageEvidence:
    k = len(get_effect(name).fitted())
    total = _Fold(sum(f.gram for f in folds), sum(f.score for f in folds))  # type: ignore[arg-type]
    seen = total.gram.diagonal().view(frames, k).sum(1) > 0
    count = int(seen.sum())

    def solve(fold: _Fold, penalty: float) -> Tensor:
        matrix = fold.gram + penalty * torch.eye(len(fold.gram), dtype=torch.float64)
        return torch.linalg.solve(matrix, fold.score)

    # directions that the nominal model can nearly imitate are shrunk as far as held-out blocks ask for
    cls = get_effect(name)
    typical = max(cls.strong.values())
    tried = []
    for level in (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0):  # prior standard deviation over a realistic size
        penalty = 1 / (level * typical) ** 2
        gain = 0.0
        for fold, other in ((folds[0], folds[1]), (folds[1], folds[0])):
            guess = solve(other, penalty)
            gain += float(guess @ fold.score - 0.5 * guess @ (fold.gram @ guess))
        tried.append((gain, penalty))
    top = max(g for g, _ in tried)
    # the strictest prior that loses next to nothing: what the nominal model can imitate costs nothing and means nothing
    gain, penalty = next((g, q) for g, q in tried if g >= top - max(0.03 * abs(top), 2.0))
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
    matrix = total.gram + penalty * torch.eye(len(total.gram), dtype=torch.float64)
    errors = torch.linalg.inv(matrix).diagonal().clamp(min=0).sqrt().view(frames, k)
    values = torch.where(seen[:, None], values, 0.0)
    rms = math.sqrt(float(values[seen].square().sum(1).mean())) if count else 0.0
    spread = math.sqrt(float(errors[seen].square().sum(1).mean()) / max(count, 1)) if count else 0.0
    return ImageEvidence(
        name, values.float(), errors.float(), rms, spread, gain,
        math.sqrt(2 * max(gain, 0.0) + count * k), p,
        math.sqrt(max(float(flat @ total.gram @ flat), 0.0) / max(rows, 1.0)), count,
    )  # fmt: skip


def as_effect(evidence: ImageEvidence, known: Effect | None, data: Survey) -> Effect:
    """The effect with its values per image; increments are added to values known already."""
    cls = get_effect(evidence.effect)
    values = {}
    for k, parameter in enumerate(cls.fitted()):
        increment = evidence.values[:, k]
        values[parameter.name] = increment + known.values[parameter.name] if known is not None else increment
    return cls(values, data)


__all__ = ["ImageEvidence", "as_effect", "weigh_images"]
