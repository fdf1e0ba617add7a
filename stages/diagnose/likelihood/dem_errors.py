"""How much of a DEM's relief may be errors, wave by wave: no more than the relief that images show and the DEM has not.

A DEM that is off by e predicts shading that is not there, and images show it as relief -e. So the rendering is too rough where errors are
a good part of the relief, as if the optics were worse or the DEM were to be smoothed (errors in variables: Fuller 1987, Measurement error models).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.model.chain import Chain
from stages.diagnose.rows.patches import Grid, Patch, window


def kept_share(
    chains: Sequence[Chain], patches: Sequence[Patch], grid: Grid, model: Covariance
) -> Callable[[Tensor], Tensor]:
    """Share of the DEM's waves, by their number in rad/px, that is relief if all that images show beside it is errors of the DEM."""
    total = torch.zeros(grid.annuli, dtype=torch.float64)
    waves = torch.bincount(grid.annulus, minlength=grid.annuli)
    taper = window(grid.height, grid.width)
    along = grid.direction[grid.sector].T
    for patch in patches:
        here = torch.stack([s[0, patch.rows, patch.columns] for s in chains[patch.site].state.slopes])
        z = torch.fft.rfft2((here - here.mean((-2, -1), keepdim=True)) * taper).flatten(-2)[:, grid.keep]
        power = (z * along).sum(0).abs().square().double() / (here[0].numel() * float(taper.square().mean()))
        total.index_add_(0, grid.annulus, power)
    dem = total / (waves * max(len(patches), 1))
    share = (1 - model.relief / dem.clamp(min=1e-30)).clamp(0, 1)
    radius = 2 * np.pi * np.asarray(model.radius)

    def kept(waves: Tensor) -> Tensor:
        return torch.from_numpy(np.interp(waves.numpy(), radius, share.numpy())).to(waves)

    return kept


__all__ = ["kept_share"]
