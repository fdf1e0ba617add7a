"""What all images of a site have in common tells of the ground by itself: patterns that stand out of ordinary texture.

The covariance takes whatever they share for ground, so that no other cause is drowned by it. Effects with values per site say what they
read off it (``read_off_ground``); it is named where images that it was not read off from show it, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from stages.common.intervals import student_quantile
from stages.diagnose.data.parallel import per_site
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.patches import judged
from stages.diagnose.model.chain import Chain
from stages.diagnose.sources.measured import Measured, measured
from stages.effects import Effect, effect_names, get_effect

PARTS = 2  # of a site's images: what is read off from one is judged on the other
WHOLE = 0.9  # of a crop: holes tear texture up, and what is torn has no spectrum


def by_ground(state: State) -> list[Measured]:
    """What the ground shows of every effect with values per site."""
    chains = [c for c in state.chains() if c.site.count >= PARTS]
    if len(chains) < 3:  # no interval
        return []
    left = per_site(relative, chains)
    out = []
    for name in effect_names():
        cls = get_effect(name)
        whole = _read_off(cls, left, [slice(None)])
        if whole is None:
            continue
        values, size, usual = whole
        known = torch.isfinite(size)
        excess = (size - usual)[known].double().numpy()
        if len(excess) < 3:
            continue
        value = math.sqrt(max(float(excess.mean()), 1e-12))
        error = float(excess.std(ddof=1)) / math.sqrt(len(excess))  # of the square
        half = student_quantile(len(excess) - 1) * error
        effect = _of_sites(cls, values, state, chains)
        parameter = cls.parameters[0].name
        out.append(
            measured(
                effect,
                (parameter, value, math.sqrt(half) / 2),
                {parameter: (value, error / (2 * value))},
                *_on_other_images(cls, state, chains, left),
                away=value**2 / max(error, 1e-30),
                power=2,
            )
        )
    return out


def relative(chain: Chain) -> tuple[Tensor, Tensor]:
    """(n, H, W) residual over the prediction on fully lit ground, 0 elsewhere, and what it weighs there: the inverse of an image's variance."""
    lit, _ = judged(chain)
    residual = torch.where(lit, chain.site.image / chain.predict().clamp(min=1e-6) - 1, 0.0)
    count = lit.sum((-2, -1)).clamp(min=1)
    variance = residual.square().sum((-2, -1)) / count
    return residual, lit / variance.clamp(min=1e-8)[:, None, None]


def _read_off(cls: type[Effect], left: Sequence[tuple[Tensor, Tensor]], parts: Sequence[slice]):
    """What the effect reads off the mean of these images of every site; a field of the effect that no site knows is None."""
    maps, seen = [], []
    for residual, weight in left:
        some = torch.cat([torch.arange(len(weight))[p] for p in parts])
        total = weight[some].sum(0)
        maps.append((residual * weight)[some].sum(0) / total.clamp(min=1e-9))
        seen.append((total > 0).float())
    found = cls.read_off_ground(torch.stack(maps), torch.stack(seen))
    if found is None:
        return None
    values, size, usual = found
    whole = torch.stack(seen).mean((-2, -1)) > WHOLE
    return {k: torch.where(whole, v, 0.0) for k, v in values.items()}, torch.where(whole, size, torch.nan), usual


def _of_sites(cls: type[Effect], values, state: State, chains: Sequence[Chain]) -> Effect:
    """The effect with these values of the chains' sites in tables by the sites' numbers."""
    numbers = torch.tensor([c.site.number for c in chains])
    tables = {k: torch.zeros(int(numbers.max()) + 1).index_copy(0, numbers, v) for k, v in values.items()}
    return cls(tables, state.data)


def _on_other_images(
    cls: type[Effect], state: State, chains: Sequence[Chain], left
) -> tuple[np.ndarray, np.ndarray, float]:
    """Squared relative residuals of every site without the effect, and with what its other images say of it; their pixels."""
    before, after, pixels = np.zeros(len(chains)), np.zeros(len(chains)), 0.0
    for part in range(PARTS):
        others = [slice(k, None, PARTS) for k in range(PARTS) if k != part]
        found = _read_off(cls, left, others)
        assert found is not None
        effect = _of_sites(cls, found[0], state, chains)
        for k, (chain, (residual, weight)) in enumerate(zip(chains, left, strict=True)):
            image, lit = residual[part::PARTS], (weight[part::PARTS] > 0).double()
            more = (chain.render(effect) / chain.render().clamp(min=1e-6) - 1)[part::PARTS]
            before[k] += float((image.double().square() * lit).sum())
            after[k] += float(((image - more).double().square() * lit).sum())
            pixels += float(lit.sum())
    return before, after, max(pixels, 1.0)


__all__ = ["WHOLE", "by_ground", "relative"]
