"""A broad field in an image that comes back on all ground, as stray light, vignetting and film make it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stages.common.intervals import student_quantile
from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.jackknife import jackknife_error
from stages.diagnose.likelihood.products import Rows, whitened_residual
from stages.diagnose.rows.patches import Grid
from stages.diagnose.settings import BROADEST


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


__all__ = ["field_of_images"]
