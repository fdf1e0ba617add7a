"""What an image has of its own beside the other images of its place tells of its frame: patterns too broad for relief.

Errors of the DEM and of the law are an image's own, too, and broad where they are large. They have finer waves as well, and more of both where shading
is strong. So the broad power of every image is compared with that of its finer waves: what it has where there is nothing finer than noise is the frame's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.common.intervals import student_quantile
from stages.diagnose.data.parallel import per_site
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.intervals import folds, jackknife_error
from stages.diagnose.model.chain import Chain
from stages.diagnose.settings import CELL, ROUNDS
from stages.diagnose.sources.ground import WHOLE, relative
from stages.diagnose.sources.measured import Measured, measured
from stages.effects import Effect, effect_names, get_effect
from stages.effects.base import Survey, Values

NEARBY = 30.0  # times the least finer power: with more an image tells of the law and relief alone, whose broad power need not go with their finer one
FEWEST = 6  # images of places: of fewer, the broad power that goes with finer waves is not known


@dataclass
class Own:
    """Images of one site that show nearly all of the crop: what each has of its own beside the others, and where it is known, 1 or 0, (n, H, W);

    number : (n,) of each among the site's images; share : (n,) of their broad power that does not go with finer waves
    """

    chain: Chain
    number: Tensor
    left: Tensor
    seen: Tensor
    share: Tensor

    @property
    def frames(self) -> NDArray[np.int64]:
        """(n,) of the whole data set."""
        return self.chain.site.frames[self.number.numpy()]


def by_images(state: State) -> list[Measured]:
    """What each image has of its own of every effect with values per image of a site."""
    catalogue = map(get_effect, effect_names(unlisted=True))
    classes = [c for c in catalogue if c.scope == "pair" and c.visible(state.data, state.has)]
    sites = _own(state) if classes else []
    out: list[Measured] = []
    if sum(len(site.number) for site in sites) < FEWEST:
        return out
    frames = np.concatenate([site.frames for site in sites])
    # of frames that show one place each, images of a place are known from each other alone, and two of them tell the same
    if len(np.unique(frames)) == len(frames):
        frames = np.concatenate([np.full(len(site.frames), k) for k, site in enumerate(sites)])
    for cls in classes:
        read = [cls.read_off_image(site.left, site.seen) for site in sites]
        found = [x for x in read if x is not None]
        if not found:
            continue
        # the others' mean, which was taken away, has a share of theirs
        power = np.concatenate([(1 - 1 / s.chain.site.count) * x[1].numpy() for s, x in zip(sites, found, strict=True)])
        finer = np.concatenate([x[2].numpy() for x in found])
        size, error, freedom, share = without_finer(power, finer, frames)
        value = math.sqrt(max(size, 1e-12))
        half = math.sqrt(student_quantile(freedom) * error) / 2
        ends = np.cumsum([len(site.number) for site in sites])
        for site, part in zip(sites, np.split(share, ends[:-1]), strict=True):
            site.share = torch.from_numpy(part).float()
        was, now, pixels = _on_other_ground(cls, sites, state.data)
        effect = cls(_tables(sites, [x[0] for x in found]), state.data)
        name = cls.parameters[0].name
        # each image weighs as the inverse of its variance
        every = float(pixels.sum())
        made = measured(
            effect, (name, value, half), {name: (value, error / (2 * value))}, pixels, pixels * now / was, every,
            away=size / max(error, 1e-30), power=2,
        )  # fmt: skip
        made.named.rms_before, made.named.rms_after = (math.sqrt(float(x.sum()) / every) for x in (was, now))
        out.append(made)
    return out


def without_finer(power: NDArray, finer: NDArray, frame: NDArray) -> tuple[float, float, int, NDArray]:
    """Mean power (N,) of images beside what goes with that of their finer waves; its standard error over frames, and the degrees of freedom of that;

    and the share of it in each image's power, (N,).

    A straight line, never falling, whose scatter goes with its height (gamma regression). How much of the least finer power is noise, beside which
    an image has nothing broad, is open: the line is read at half of it, and what it may be at none and at all of it is part of the error.
    """
    finer = np.maximum(finer, 1e-12)
    least = float(np.quantile(finer, 1 / FEWEST))
    noise = least / 2

    def at_noise(kept: NDArray) -> tuple[float, float]:
        kept = kept & (finer <= NEARBY * least)
        x, y = finer[kept] - noise, power[kept]
        height = finer[kept]
        for _ in range(ROUNDS):
            w = height**-2.0
            middle, mean = np.average(x, weights=w), np.average(y, weights=w)
            apart = x - middle
            slope = max(float((w * apart * y).sum() / max((w * apart**2).sum(), 1e-300)), 0.0)
            height = np.maximum(mean + slope * apart, 0.1 * mean)
        return float(mean - slope * middle), slope

    # images of three frames may be of thirty places
    unit = np.unique(frame, return_inverse=True)[1] if len(np.unique(frame)) >= FEWEST else np.arange(len(frame))
    part = folds(int(unit.max()) + 1)[unit]
    parts = np.unique(part)
    error = float(jackknife_error(np.array([at_noise(part != k)[0] for k in parts])))
    size, slope = at_noise(np.ones(len(power), bool))
    error = math.hypot(error, slope * noise / math.sqrt(3))  # of a number that is anywhere up to as far away
    share = size / np.maximum(size + slope * np.maximum(finer - noise, 0.0), 1e-300)
    return size, error, len(parts) - 1, np.clip(share, 0.0, 1.0)


def _own(state: State) -> list[Own]:
    """Of every site that several images show."""
    chains = [c for c in state.chains() if c.site.count > 1]
    out = []
    for chain, (left, weight) in zip(chains, per_site(relative, chains), strict=True):
        others = weight.sum(0) - weight
        mean = ((left * weight).sum(0) - left * weight) / others.clamp(min=1e-9)
        seen = (weight > 0) & (others > 0)
        whole = torch.nonzero(seen.float().mean((-2, -1)) > WHOLE)[:, 0]
        if len(whole):
            own = torch.where(seen, left - mean, 0.0)
            out.append(Own(chain, whole, own[whole], seen[whole].float(), torch.ones(len(whole))))
    return out


def _tables(sites: Sequence[Own], values: Sequence[Values]) -> Values:
    """Coordinate -> likeliest values by frame and site, (frames, sites): without what goes with finer waves."""
    shape = [max(int(s.frames.max()) for s in sites) + 1, max(s.chain.site.number for s in sites) + 1]
    tables = {name: torch.zeros(shape) for name in values[0]}
    for site, found in zip(sites, values, strict=True):
        for name, value in found.items():
            tables[name][torch.from_numpy(site.frames), site.chain.site.number] = site.share * value
    return tables


def _on_other_ground(cls: type[Effect], sites: Sequence[Own], data: Survey) -> tuple[NDArray, NDArray, NDArray]:
    """Squares of every image without the effect, and with what the other squares of a chessboard say of it; its pixels."""
    out = []
    for site in sites:
        height, width = site.seen.shape[-2:]
        board = (torch.arange(height)[:, None] // (2 * CELL) + torch.arange(width) // (2 * CELL)) % 2
        sums = torch.zeros(3, len(site.number), dtype=torch.float64)
        for colour in (0, 1):
            here = site.seen * (board == colour)
            found = cls.read_off_image(site.left, site.seen - here)
            assert found is not None
            more = site.chain.render(cls(_tables([site], [found[0]]), data)) / site.chain.render().clamp(min=1e-6) - 1
            left = site.left - more[site.number]
            each = [site.left.double().square() * here, left.double().square() * here, here.double()]
            sums += torch.stack([x.sum((-2, -1)) for x in each])
        out.append(sums.numpy())
    was, now, pixels = np.concatenate(out, 1).astype(np.float64)
    return np.maximum(was, 1e-30), now, pixels


__all__ = ["by_images", "without_finer"]
