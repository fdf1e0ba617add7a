"""How the variance of the residual is shared out among what is named, what images of a place share, what each has of its own, and noise."""

from __future__ import annotations

import math

import torch

from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.patches import Grid, make_patches
from stages.diagnose.likelihood.products import Rows
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import lit_mask


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


def mean_square(state: State) -> float:
    """Mean square of the relative residual in the windows."""
    grid, pieces = state.grid()
    total, count = 0.0, 0.0
    for k, chain in enumerate(state.chains()):
        residual = (chain.site.image - chain.predict())[None]
        if (
            state.free_gains
        ):  # relative to the image as it was read: a gain that is fitted too low would blow residuals up
            residual = residual * _as_read(chain)
        for patch in make_patches(k, chain, pieces, state.free_gains):
            z, mean = patch.transform(residual, grid)
            total += float((z.real.square() + z.imag.square()).sum())
            area = patch.weight.square().sum((-2, -1))
            if not patch.free:
                total += float((mean.square() * area).sum())
            count += float(area.sum())
    return total / count if count else math.nan


def _as_read(chain: Chain) -> torch.Tensor:
    """(n, 1, 1) by which a residual over the prediction's mean gets one over the read image's mean."""
    site = chain.site
    lit = lit_mask(chain).float()
    count = lit.sum((-2, -1)).clamp(min=1)
    ratio = (chain.predict() * lit).sum((-2, -1)) / count * site.gain.abs()
    return (ratio / ((site.read * lit).sum((-2, -1)) / count).clamp(min=1e-9))[:, None, None]


__all__ = ["budget", "mean_square"]
