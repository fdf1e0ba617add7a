"""Lines of an image shifted against each other, as the trembling pointing of a line-scan camera leaves them.

Every image has waves over its own lines. What one half of the samples of its lines says of them is asked of the other half: ground that is
displaced for another reason is not displaced alike all along a line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.likelihood.jackknife import jackknife_error
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import full_light
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.forms import asked
from stages.diagnose.registration.start import Field
from stages.diagnose.settings import CAPTURE, ROUNDS
from stages.effects.line_jitter import ORDERS, LineJitter, crop_waves

SHORTEST = 16  # px: on shorter waves the samples of a line scatter more than it is shifted
TURNS = 3  # of rendering where the lines lie and asking again
STEADY, TREMBLING = "steady", "trembling"  # names of the squares without and with what other samples say of a line


@dataclass
class Lines:
    """How far lines are shifted. variance : (K,) px2 of each wave in either direction; rms : px, and its error over ground

    known, fields, across : displacement of every site without, by all samples, and as the other half of them has it
    """

    variance: Tensor
    rms: float
    error: float
    known: list[Field]
    fields: list[Field]
    across: list[Field]

    @property
    def ordinary(self) -> bool:
        """Whether lines are shifted no more than any camera's."""
        return self.rms**2 - self.error**2 <= LineJitter.tolerance["rms_px"] ** 2

    def over_the_crop(self, sites: Sequence[Site], frames: int) -> Tensor:
        """(frames, coordinates of ``line_jitter``) px: the part that goes with the rows of a crop, the mean of all that show a frame."""
        total, count = torch.zeros(frames, 2, len(ORDERS)), torch.zeros(frames)
        for site, near, field in zip(sites, self.known, self.fields, strict=True):
            rows = crop_waves(site.read.shape[-2])
            shift = torch.stack([b - a for a, b in zip(near, field, strict=True)], 1).mean(-1)
            of = torch.from_numpy(site.frames)
            total.index_add_(0, of, shift @ rows.T / rows.shape[1])
            count.index_add_(0, of, torch.ones(len(of)))
        return total.flatten(1) / count.clamp(min=1)[:, None]


def lines(chains: Sequence[Chain], known: Sequence[Field], variance: Tensor | None = None) -> Lines:
    """Beside a displacement ``known`` per site, each image's own shift open; what is ordinary is left alone.

    variance : of the waves, estimated where None
    """
    waves = per_site(lambda chain: _line_waves(chain.site), chains)
    halves = [_first_half(chain.site) for chain in chains]
    some = torch.full((waves[0].shape[1],), 0.01, dtype=torch.float64)
    found = Lines(some if variance is None else variance, 0.0, 0.0, list(known), list(known), list(known))
    for _ in range(TURNS):
        every = list(zip(chains, found.fields, known, waves, halves, strict=True))
        asks = per_site(lambda site: _equations(*site), every)
        unlike = float(np.median(np.concatenate([_differences(*site) for site in asks])))  # pixels per independent one
        asks = [(gram / unlike, score / unlike) for gram, score in asks]
        if variance is None:
            found.variance, found.rms, found.error = _scatter(asks, found.variance)
            if found.ordinary:
                break
        amounts = [_solve(gram.sum(0), score.sum(0), found.variance)[0] for gram, score in asks]
        found.fields = [_moved(near, mean, w) for near, mean, w in zip(known, amounts, waves, strict=True)]
        found.across = []
        for (gram, score), near, w, first in zip(asks, known, waves, halves, strict=True):
            one, other = (_moved(near, _solve(g, s, found.variance)[0], w) for g, s in zip(gram, score, strict=True))
            found.across.append((torch.where(first, other[0], one[0]), torch.where(first, other[1], one[1])))
    return found


def _scatter(asks: Sequence[tuple[Tensor, Tensor]], variance: Tensor) -> tuple[Tensor, float, float]:
    """Variance of every wave (K,), px2, by expectation-maximisation from a first guess; rms of all waves in both directions, px, and its error over
    ground. asks : products of every site, as :func:`_equations` has them
    """

    def size(of: Tensor) -> float:
        return math.sqrt(2 * float(of.sum()))

    squares = variance.expand(len(asks), -1)
    for _ in range(ROUNDS):
        solved = [_solve(gram.sum(0), score.sum(0), variance) for gram, score in asks]
        squares = torch.stack([(mean.square() + spread).mean((0, 1)) for mean, spread in solved])
        variance = squares.mean(0).clamp(min=1e-8)
    without = [size((squares.sum(0) - own) / max(len(asks) - 1, 1)) for own in squares]
    return variance, size(variance), float(jackknife_error(np.array(without)))


def _line_waves(site: Site) -> Tensor:
    """(n, K, H, W): cosines over the detector lines that show the site, of mean square 1."""
    line = site.on_detector()[:, 0]
    line = line.nan_to_num(float(line.nanmean()))
    low, high = (edge.view(-1, 1, 1) for edge in (line.flatten(1).amin(1), line.flatten(1).amax(1)))
    along = (line - low) / (high - low).clamp(min=1e-6)
    orders = range(1, 2 * site.read.shape[-2] // SHORTEST + 1)
    return torch.stack([math.sqrt(2) * torch.cos(math.pi * k * along) for k in orders], 1)


def _first_half(site: Site) -> Tensor:
    """(n, H, W) bool: half of the samples of each line."""
    sample = site.on_detector()[:, 1]
    return sample < sample.flatten(1).nanmedian(1).values[:, None, None]


def _equations(chain: Chain, field: Field, known: Field, waves: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """Products (2, n, P, P) and (2, n, P) of either half of the samples, P = 2 + 2 K: a shift, and waves beside ``known``, east and south;
    linearised at ``field``.
    """
    residual, east, south, weight = asked(chain, full_light(chain), field)
    target = residual + east * (field[0] - known[0]) + south * (field[1] - known[1])
    slopes = torch.stack([east, south], 1)
    columns = torch.cat([slopes, *(slope[:, None] * waves for slope in (east, south))], 1).flatten(2)
    grams, scores = [], []
    for half in (first, ~first):
        weighted = columns * (weight * half).flatten(1)[:, None]
        grams.append((weighted @ columns.transpose(1, 2)).double())
        scores.append(torch.einsum("npx,nx->np", weighted, target.flatten(1)).double())
    return torch.stack(grams), torch.stack(scores)


def _differences(gram: Tensor, score: Tensor) -> NDArray[np.float64]:
    """(n,) squares of what is between the values that either half says, over those that pixels without correlation would make; of (2, n, P, P)
    and (2, n, P).
    """
    known = torch.linalg.inv(gram + CAPTURE**-2 * torch.eye(gram.shape[-1]))
    one, other = torch.einsum("hnab,hnb->hna", known, score)
    apart = torch.einsum("na,nab,nb->n", one - other, torch.linalg.inv(known.sum(0)), one - other)
    return (apart / gram.shape[-1]).numpy()


def _solve(gram: Tensor, score: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Amounts of the waves (n, 2, K), drawn to nothing, and their variances."""
    precision = torch.cat([torch.ones(2, dtype=torch.float64), *2 * [1 / variance]])
    inverse = torch.linalg.inv(gram + torch.diag(precision))
    mean = torch.einsum("nab,nb->na", inverse, score)
    shape = len(mean), 2, len(variance)
    return mean[:, 2:].view(shape), inverse.diagonal(dim1=1, dim2=2)[:, 2:].reshape(shape)


def _moved(field: Field, amounts: Tensor, waves: Tensor) -> Field:
    east, south = torch.einsum("nak,nkhw->anhw", amounts.float(), waves)
    return field[0] + east, field[1] + south


__all__ = ["STEADY", "TREMBLING", "Lines", "lines"]
