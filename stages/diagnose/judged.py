"""Lit pixels whose brightness is a matter of reflectance: not of relief below the DEM's resolution, nor of the DEM's errors."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from stages.diagnose.chain import Chain

CUT = math.radians(15)  # the Sun above a slope and above the horizon, at least ...
RUGGED = 1.35  # ... and on rugged ground this many times its rms slope
HARDLY_ANY = 0.1  # of a site's pixels: all are taken where no more would be left
MOST = 0.5  # of an image's lit pixels: the DEM's errors choose fewer, slopes that only seem to face the Sun
LEAST = 0.2  # of all lit pixels, in such images, from which anything can be told


def rising(chain: Chain) -> Tensor:
    """The Sun above the facet's own plane and above the horizon, the lower of them, rad, (n, H, W)."""
    own = torch.asin(chain.state.angles.cos_incidence.clamp(-1, 1))
    above = chain.height_above_horizon()
    return own if above is None else torch.minimum(above, own)


def judged(chain: Chain, use: Tensor, sun: Tensor) -> Tensor:
    """Of the pixels in ``use`` those that are judged, (n, H, W) bool; all of them where hardly any are. sun : as of ``rising``"""
    clear = use & (sun > max(CUT, _rugged(chain)))
    return clear if float(clear.sum()) > HARDLY_ANY * float(use.sum()) else use


def clear_and_lit(chain: Chain) -> tuple[float, float]:
    """Counts of lit pixels: those clear of the ground's own slopes, in images that show most of their lit ground so; and all."""
    sun = rising(chain)
    lit, clear = (((sun > least) & chain.site.valid).sum((-2, -1)) for least in (0.0, _rugged(chain)))
    return float(clear[clear > MOST * lit].sum()), float(lit.sum())


def _rugged(chain: Chain) -> float:
    east, north = chain.state.slopes
    return RUGGED * math.atan(float((east.square() + north.square()).mean().sqrt()))
