"""What is left: how its variance is shared out, and whether it has what no covariance of ground or noise has: a single wave that stands out,
or a broad field in an image that comes back on all ground.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.ndimage import median_filter
from scipy.special import gammaincinv
from torch import Tensor

from stages.common.intervals import student_quantile
from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.jackknife import jackknife_error
from stages.diagnose.likelihood.products import Rows, whitened_residual
from stages.diagnose.likelihood.tails import surprise
from stages.diagnose.rows.patches import Grid
from stages.diagnose.settings import BROADEST, FAR, NEAR, PEAK


def budget(rows: list[Rows], model: Covariance, grid: Grid, before: float, after: float) -> dict[str, float]:
    """Shares of the variance ``before`` anything was named; ``after`` is what is left. Sum 1."""
    waves = torch.bincount(grid.annulus, weights=grid.root.double() ** 2, minlength=grid.annuli)
    bend = torch.stack([(r.patch.slopes.double() @ grid.direction.double().T).square().mean() for r in rows]).mean()
    common = float(((model.albedo + model.relief * bend) * waves).sum()) + (
        0.0 if rows[0].patch.free else model.mean_albedo
    )
    every = model.own.mean(1)
    floor = float(every.min())
    noise = floor * float(waves.sum())
    own = float(((every - floor) * waves).sum()) + (0.0 if rows[0].patch.free else model.mean_own)
    named = min(max(1 - after / before, 0.0), 1.0) if before > 0 else 0.0
    total = max(common + own + noise, 1e-30)
    return {
        "named": named,
        "common_to_images": (1 - named) * common / total,
        "own_to_image": (1 - named) * own / total,
        "noise": (1 - named) * noise / total,
    }


def field_of_images(rows: list[Rows], model: Covariance, grid: Grid) -> tuple[float, float]:
    """Of the squares of the broadest waves, the share that an image has alike on all ground that falls on the same part of its detector,
    and the lower bound of that (95 %).

    Stray light, vignetting and film do that. Ground does not, and noise does not come back; products of different ground have neither.
    """
    broad = grid.annulus < BROADEST
    pieces: dict[int, list[tuple[int, Tensor, Tensor]]] = {}
    for row in rows:
        z, _, _ = whitened_residual(row, model, grid)
        size = row.patch.weight.square().mean((-2, -1)) * model.size.get(row.patch.number, 1.0)
        z = z[:, broad] / size.clamp(min=1e-6).sqrt()[:, None]
        for k, frame in enumerate(row.patch.frames.tolist()):
            pieces.setdefault(frame, []).append((row.patch.site, row.patch.middle[k], z[k]))
    alike, squares = np.zeros((2, 1 + max(r.patch.site for r in rows)))
    for every in pieces.values():
        ground = torch.tensor([piece[0] for piece in every])
        middle, z = torch.stack([piece[1] for piece in every]), torch.stack([piece[2] for piece in every])
        near = (middle[:, None] - middle).abs().amax(-1) < min(grid.height, grid.width) / 8
        others = (near & (ground[:, None] != ground)).to(z.dtype)
        count = others.real.sum(1)
        mean = others @ z / count.clamp(min=1)[:, None]
        np.add.at(alike, ground.numpy(), (z.conj() * mean).real.sum(1).double().numpy())
        np.add.at(squares, ground[count > 0].numpy(), z[count > 0].abs().square().sum(1).double().numpy())
    alike, squares = alike[squares > 0], squares[squares > 0]
    grounds = len(squares)
    if grounds < 3:
        return 0.0, 0.0
    share = float(alike.sum() / squares.sum())
    # every product is one of two pieces of ground: without one of them those that are left are fewer, and weigh more
    without = (alike.sum() - 2 * alike) / (squares.sum() - squares) * (grounds - 1) / (grounds - 2)
    return share, share - student_quantile(grounds - 1) * float(jackknife_error(without))


def peak(rows: list[Rows], model: Covariance, grid: Grid, frames: int) -> tuple[float, float]:
    """-log10 of the chance of the strongest single wave of any frame among all of them, and its share of the residual's variance."""
    power = torch.zeros(frames, len(grid.keep), dtype=torch.float64)
    count = torch.zeros(frames, dtype=torch.float64)
    for row in rows:
        z, _, _ = whitened_residual(row, model, grid)
        size = (row.patch.weight.square().mean((-2, -1)) * model.size.get(row.patch.number, 1.0)).clamp(min=1e-6)
        share = (z.real.square() + z.imag.square()).double() / size[:, None]
        power.index_add_(0, row.patch.frames, share)
        count.index_add_(0, row.patch.frames, torch.ones(len(row.patch.frames), dtype=torch.float64))
    seen = count > 0
    power, count = power[seen], count[seen]
    best, largest = 0.0, 0.0
    # broad waves are ground and film; of those in the corners, shorter than two pixels, images that were resampled have next to nothing
    fine = (grid.annulus >= 2) & (torch.hypot(*grid.waves) <= 0.5)
    for p, n in zip(power, count, strict=True):
        level = torch.zeros(grid.annuli, dtype=torch.float64)
        for a in range(grid.annuli):
            level[a] = p[grid.annulus == a].median()
        ratio = p / level[grid.annulus].clamp(min=1e-30)
        ratio = (ratio / _about(ratio, grid).clamp(min=1))[fine]
        top = float(ratio.max())
        shape = max(float(n), 1.0)
        middle = float(gammaincinv(shape, 0.5))
        chance = float(surprise(np.array([2 * top * middle]), 2 * shape)[0]) - math.log10(len(ratio) * len(power))
        # neighbours share a wave through the window: what stands out by a little is no line
        if top > PEAK and chance > best:
            best, largest = chance, float((p[fine] * (ratio > PEAK)).sum() / p.sum())
    return best, largest


def _about(power: Tensor, grid: Grid) -> Tensor:
    """(K,) median power of the waves some way off each one: slanting light and optics make power go with direction, in no line."""
    columns = grid.width // 2 + 1
    row, column = grid.keep // columns, grid.keep % columns
    plane = np.full((grid.height, grid.width), float(power.median()))
    plane[row, column] = power
    plane[-row % grid.height, -column % grid.width] = power
    y, x = np.ogrid[-FAR : FAR + 1, -FAR : FAR + 1]
    ring = (np.hypot(y, x) <= FAR) & (np.hypot(y, x) > NEAR)
    return torch.from_numpy(median_filter(plane, footprint=ring, mode="wrap")[row, column])


__all__ = ["budget", "field_of_images", "peak"]
