"""Brightness that piles up at one level: images that were cut off there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.data.sites import Site
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.intervals import folds
from stages.diagnose.model.nominal import full_light
from stages.diagnose.settings import ROUNDS
from stages.diagnose.sources.measured import Measured, measured
from stages.effects import Effect, effect_names, get_effect
from stages.effects.filters import gaussian

ENDLESS = 1e9  # a gain that takes all lit ground beyond any level


@dataclass
class Cut:
    """A level at which brightness piles up, as read. images, masks : of every site before what is near the level was masked; share : of the pixels"""

    cls: type[Effect]
    level: float
    error: float
    share: float
    images: list[Tensor]
    masks: list[Tensor]


def by_histogram(sites: Sequence[Site]) -> Cut | None:
    """Find a level in the histogram of all pixels, and mask what lies near it."""
    bright = torch.cat([s.read[s.read_valid].flatten() for s in sites])
    for cls in map(get_effect, effect_names()):
        found = cls.read_off(bright)
        if found is None:
            continue
        level, error, _ = found
        share = float((bright > level - error).float().mean())
        cut = Cut(cls, level, error, share, [s.read for s in sites], [s.read_valid for s in sites])
        for site in sites:
            near = gaussian(torch.where(site.read_valid, site.read, 0.0), 1.0)
            site.read_valid = (
                site.read_valid & (site.read < cls.keep_below * level) & (near < cls.keep_below**3 * level)
            )
            site.valid = site.read_valid
        return cut
    return None


def by_clipping(state: State, cut: Cut) -> Measured:
    """Whether clipping the prediction at the level brings it nearer to ground that the level was not read off from."""
    gain, offset = state.exposure
    (parameter,) = cut.cls.parameters
    value, error = (cut.level - offset) / gain, cut.error / gain
    effect = cut.cls({parameter.name: value}, state.data)
    return measured(
        effect,
        (parameter.name, value, error),
        {parameter.name: (value, error)},
        *_clipped(state, cut.images, cut.masks, cut.cls),
    )


def _own_gain(image: Tensor, plain: Tensor, use: Tensor, top: float = math.inf) -> Tensor:
    """(n, 1, 1) by least squares over the pixels in use, of what is cut off at ``top``; image, plain, use : (n, H, W)."""
    gain = torch.ones_like(plain[:, :1, :1])
    for _ in range(ROUNDS if math.isfinite(top) else 1):
        below = use & (gain * plain < top) if math.isfinite(top) else use
        across = (image * plain * below).sum((-2, -1), keepdim=True)
        found = across / (plain.square() * below).sum((-2, -1), keepdim=True).clamp(min=1e-12)
        # of an image that is cut off as a whole any gain is as good that is high enough
        gain = torch.where(below.any(-1, keepdim=True).any(-2, keepdim=True), found, ENDLESS)
    return gain


def _albedo(image: Tensor, plain: Tensor, tells: Tensor) -> Tensor:
    """(n, H, W) factors on the predicted brightness of every image by which its ground is brighter in the other images; 1 where none tells."""
    across, power = image * plain * tells, plain.square() * tells
    across, power = across.sum(0) - across, power.sum(0) - power
    return torch.where(power > 0, across / power.clamp(min=1e-12), 1.0)


def _clipped(
    state: State, images: Sequence[Tensor], masks: Sequence[Tensor], cls: type[Effect]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Squared relative residuals of every quarter of a site's ground, without and with the level of the other ground; their pixels.

    Every image has its own gain, fitted to its other quarters where these are not cut off, for the law may be extrapolated to it, and the albedo that
    the other images of its ground show: it is bright ground that is cut off.
    """
    quarters = [(k, rows) for k, x in enumerate(images) for rows in range(4)]

    def part(k: int, quarter: int, x: Tensor) -> Tensor:
        side = x.shape[-2] // 4
        return x[:, quarter * side : (quarter + 1) * side]

    levels = []
    group = [k if len(images) > 3 else n for n, (k, _) in enumerate(quarters)]
    of = folds(max(group) + 1)
    for fold in range(of.max() + 1):
        rest = [
            part(*q, images[q[0]])[part(*q, masks[q[0]])] for q, g in zip(quarters, group, strict=True) if of[g] != fold
        ]
        found = cls.read_off(torch.cat([r.flatten() for r in rest])) if rest else None
        levels.append(found[0] if found else math.inf)
    chains = state.chains()
    out, count = [], 0.0
    for (k, quarter), g in zip(quarters, group, strict=True):
        site = chains[k].site
        predicted = chains[k].predict() * site.gain[:, None, None] + site.offset[:, None, None]
        elsewhere = masks[k] & full_light(chains[k])
        lit = part(k, quarter, elsewhere).clone()
        part(k, quarter, elsewhere)[:] = False
        image, plain = part(k, quarter, images[k]), part(k, quarter, predicted)
        level = images[k][masks[k]].mean()
        top = levels[of[g]]
        gain = _own_gain(images[k], predicted, elsewhere, top)
        # without the level an image that it cuts off as a whole is as bright as it looks
        without = torch.where(gain < ENDLESS, gain, _own_gain(images[k], predicted, elsewhere))
        tells = part(k, quarter, masks[k]) & lit & (image < cls.keep_below * top) & (gain < ENDLESS)
        plain = plain * _albedo(image, gain * plain, tells)
        both = [torch.where(lit, image - p, 0.0) / level for p in (without * plain, (gain * plain).clamp(max=top))]
        out.append([float(left.double().square().sum()) for left in both])
        count += float(lit.sum())
    before, after = np.array(out).T
    return before, after, max(count, 1.0)


__all__ = ["Cut", "by_clipping", "by_histogram"]
