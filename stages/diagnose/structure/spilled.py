"""Whether bright pixels act on others along one direction of the detector, as charge that spills along columns does.

A response to the squared brightness, by wavelength and by direction. What optics and motion do is linear in the light, what an unknown law
does to slopes is the same in all directions or goes with those of the Sun and of the camera: all of these are fitted along. Ground knows nothing
of the detector's directions. Where the Sun or the camera stands alike in all images, its direction and the detector's cannot be told apart,
and nothing is found.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.diagnose.likelihood.found import interval
from stages.diagnose.likelihood.products import Rows
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.sites import Site
from stages.diagnose.rows.patches import Grid
from stages.diagnose.search.refine import along
from stages.diagnose.search.state import State, View


def spilled(state: State, view: View) -> tuple[float, float]:
    """Share of the weighted squares that this gains on held-out ground, beside the causes as they are fitted now, and its lower bound (95 %)."""
    whole = state.again(view, along(state, view), view.model, responses).whole
    last = range(whole.first - 2 * view.grid.annuli, whole.first)
    gains = whole.held_out(whole.known_places(last))
    squares = 0.5 * float(whole.gram[0, 0])
    return float(gains.sum()) / squares, interval(gains, whole.sizes)[0] / squares


def responses(rows: Sequence[Rows], chains: Sequence[Chain], grid: Grid) -> tuple[list[Tensor], list[Tensor]]:
    """Coefficients (k, n, K) of every row: of what is fitted along, and of squared brightness along the detector's directions."""
    known, asked = [], []
    for row in rows:
        once, twice = _of_powers(row, chains[row.patch.site], grid)
        site, images = chains[row.patch.site].site, row.patch.images
        annuli = torch.nn.functional.one_hot(grid.annulus, grid.annuli).T[:, None]
        view = site.observation.camera_position  # of the middle of the crop
        axes = _azimuth(site.observation.sun_direction), _azimuth(view), _turn(site)
        across = [2 * (_angles(grid) - axis[images][:, None]) for axis in axes]
        *lit, detector = (torch.cat([annuli * a.cos(), annuli * a.sin()]) for a in across)
        others = [annuli * once, annuli * twice, *(a * z for a in lit for z in (once, twice)), detector * once]
        known.append(torch.cat(others))
        asked.append(detector * twice)
    return known, asked


def _of_powers(row: Rows, chain: Chain, grid: Grid) -> tuple[Tensor, Tensor]:
    """(n, K) of the rendered brightness over its mean, and of its square."""
    patch, lit = row.patch, chain.lit()
    level = (chain.rendered * lit).sum((-2, -1)) / lit.sum((-2, -1)).clamp(min=1)
    bright = (chain.rendered / level.clamp(min=1e-9)[:, None, None])[patch.images, patch.rows, patch.columns]
    out = []
    for x in (bright, bright.square()):
        mean = (x * patch.weight).sum((-2, -1)) / patch.weight.sum((-2, -1)).clamp(min=1e-9)
        z = torch.fft.rfft2((x - mean[:, None, None]) * patch.weight)
        out.append(z.flatten(-2)[:, grid.keep] * grid.root)
    return out[0], out[1]


def _angles(grid: Grid) -> Tensor:
    """(K,) rad from the crop's columns to its rows, of every wave."""
    return torch.atan2(*grid.waves)


def _azimuth(direction: Tensor) -> Tensor:
    """(n,) rad from the crop's columns, which run east, of (n, 3) east, north, up; rows run south."""
    return torch.atan2(-direction[:, 1], direction[:, 0])


def _turn(site: Site) -> Tensor:
    """(n,) rad by which the detector's samples run off the crop's columns; 0 where no two neighbours have one."""
    sample = site.on_detector()[:, 1]
    return torch.atan2(sample.diff(dim=1).nanmean((-2, -1)), sample.diff(dim=2).nanmean((-2, -1))).nan_to_num()


__all__ = ["responses", "spilled"]
