"""What displacements leave of the residual: sums of squares on ground that they were not fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.data.aligned import aligned
from stages.diagnose.data.parallel import per_site
from stages.diagnose.data.sites import Site
from stages.diagnose.likelihood.intervals import folds
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import full_light
from stages.diagnose.registration.forms import FORMS, Matched, displacement, of_others, solve
from stages.diagnose.registration.start import Field

OWN = "own", "own, leaning"  # each image's own shift, without and with relief displacement


def held_out(matched: list[Matched], group: Sequence[int], frames: int, spread: float) -> list[NDArray[np.float64]]:
    """Squared residual per piece of ground and frame, (pieces, frames) for each form, fitted to other ground."""
    fold = folds(max(group) + 1)
    together = [[k for k, g in enumerate(group) if fold[g] == f] for f in np.unique(fold)]
    out = [np.zeros((max(group) + 1, frames)) for _ in FORMS]

    def of(fold: list[int]) -> list[tuple[list[int], list[list[NDArray[np.float64]]]]]:
        rest = [m for k, m in enumerate(matched) if k not in fold]
        share = solve(rest, FORMS[-1], frames, spread)[1]
        found = [solve(rest, form, frames, spread, share if form.leaning else None) for form in FORMS]
        sites = [list(own) for _, own in groupby(fold, lambda k: id(matched[k].chain))]
        fields = [[displacement(matched[own[0]], *f) for f in found] for own in sites]
        return [(own, left([matched[k] for k in own], f)) for own, f in zip(sites, fields, strict=True)]

    for places, forms in (site for fold in per_site(of, together) for site in fold):
        for into, every in zip(out, forms, strict=True):
            for k, squares in zip(places, every, strict=True):
                np.add.at(into[group[k]], matched[k].chain.site.frames, squares)
    return out


def compared(
    matched: Sequence[Matched], group: Sequence[int], fields: Mapping[str, Sequence[Field]], frames: int, pieces: int
) -> dict[str, NDArray[np.float64]]:
    """Squares (pieces of ground, frames) of several displacements, each a field per site, on the pixels that all of them keep.

    Unlike a form of the whole scene an image's own displacement needs no other ground to be known.
    """
    out = {name: np.zeros((max(group) + 1, frames)) for name in fields}
    sites = [slice(k, k + pieces) for k in range(0, len(matched), pieces)]
    every = per_site(lambda k: left(matched[sites[k]], [f[k] for f in fields.values()]), range(len(sites)))
    for of, squares in zip(sites, every, strict=True):
        for name, parts in zip(fields, squares, strict=True):
            for g, part in zip(group[of], parts, strict=True):
                np.add.at(out[name][g], matched[of.start].chain.site.frames, part)
    return out


def left(parts: Sequence[Matched], fields: Sequence[Field]) -> list[list[NDArray[np.float64]]]:
    """Of every field, for every part of one site: (n,) sums of squared relative residuals on the pixels that all fields keep, gain and offset
    per image and part taken out, and what the other images show as well.
    """
    chain = parts[0].chain
    predicted, lit = chain.predict(), full_light(chain)
    moved = [aligned(chain.site.read, chain.site.read_valid, *f) for f in fields]
    kept = lit & torch.stack([v for _, v in moved]).all(0)
    level = _brightness(chain)[:, None, None]

    def of(image: Tensor, m: Matched) -> NDArray[np.float64]:
        rows, columns = m.here
        weight = kept[:, rows, columns].double()
        n = weight.sum((-2, -1), keepdim=True).clamp(min=1)

        def varied(x: Tensor) -> Tensor:
            x = x[:, rows, columns] * weight
            return (x - x.sum((-2, -1), keepdim=True) / n) * weight

        x, y = varied(predicted), varied(image)
        slope = (x * y).sum((-2, -1), keepdim=True) / x.square().sum((-2, -1), keepdim=True).clamp(min=1e-20)
        rest = (y - slope.clamp(min=0) * x) / level  # brighter is brighter
        return (rest - of_others(rest, weight)).square().sum((-2, -1)).numpy()

    return [[of(image, m) for m in parts] for image, _ in moved]


def _brightness(chain: Chain) -> Tensor:
    """(n,) means as measured, so that images of all exposures count alike."""
    mask = chain.site.read_valid.double()
    return ((chain.site.read * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)).abs().clamp(min=1e-10)


def grounds(matched: Sequence[Matched], once: bool) -> list[int]:
    """Which pieces are left out together: all of a site, or each by itself where sites are few, or frames show one of them each (``once``)."""
    numbers = sorted({m.chain.site.number for m in matched})
    apart = once or len(numbers) <= 3
    return [k if apart else numbers.index(m.chain.site.number) for k, m in enumerate(matched)]


def shown_once(sites: Sequence[Site]) -> bool:
    """Whether most frames show a single site, so that no other tells where they lie."""
    often = np.bincount(np.concatenate([s.frames for s in sites]))
    return float(np.median(often[often > 0])) < 2


__all__ = ["OWN", "compared", "grounds", "held_out", "left", "shown_once"]
