"""How the variance of the residual is shared out among what is named, what images of a place share, what each has of its own, and noise."""

from __future__ import annotations

import torch

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.products import Rows
from stages.diagnose.rows.patches import Grid


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


__all__ = ["budget"]
