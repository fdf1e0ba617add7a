"""Line jitter: lines of an image shifted against each other by the camera's unsteady pointing.

The shift is a sum of waves over the lines of the detector. The two halves of the lines' samples measure each wave independently. The product
of both measurements, averaged over images, is the variance of the shift: errors of relief and brightness average to zero in it. The mean over
the images of one place is taken out first, since an error of the DEM displaces all of them alike.
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
from stages.diagnose.data.sites import Site
from stages.diagnose.likelihood.intervals import jackknife_error
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import full_light
from stages.diagnose.registration.forms import asked
from stages.diagnose.registration.start import Field
from stages.diagnose.settings import CAPTURE, ROUNDS
from stages.effects.line_jitter import ORDERS, LineJitter, crop_waves

SHORTEST = 16  # px: on shorter waves the samples of a line scatter more than it is shifted
TURNS = 3  # of rendering where the lines lie and asking again
STEADY, TREMBLING = "steady", "trembling"  # names of the squares without and with what other samples say of a line


@dataclass
class Lines:
    """Shifts of lines. variance : (K,) px2 of each wave in either direction; square : px2, mean square shift, and its standard error over
    ``grounds`` places

    known, fields, across : displacement of every site without jitter, with it from all samples, and with it from the other half of them
    """

    variance: Tensor
    square: float
    square_error: float
    grounds: int
    known: list[Field]
    fields: list[Field]
    across: list[Field]

    @property
    def rms(self) -> float:
        """Root of the mean square shift, px."""
        return math.sqrt(max(self.square, 0.0))

    @property
    def error(self) -> float:
        """Standard error of ``rms``, px."""
        return self.square_error / (2 * self.rms) if self.rms else math.inf

    @property
    def ordinary(self) -> bool:
        """Whether the 95 % interval of the mean square reaches down to the jitter of an ordinary camera."""
        half = student_quantile(self.grounds - 1) * self.square_error if self.grounds > 1 else math.inf
        return not self.square - half > LineJitter.tolerance["rms_px"] ** 2

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
    found = Lines(some if variance is None else variance, 0.0, 0.0, len(chains), list(known), list(known), list(known))
    for _ in range(TURNS):
        every = list(zip(chains, found.fields, known, waves, halves, strict=True))
        asks = per_site(lambda site: _equations(*site), every)
        unlike = float(np.median(np.concatenate([_differences(*site) for site in asks])))  # pixels per independent one
        asks = [(gram / unlike, score / unlike) for gram, score in asks]
        if variance is None:
            found.variance = _scatter(asks, found.variance)
            found.square, found.square_error = _in_both_halves(asks, found.variance)
            if found.ordinary:
                break
        amounts = [_solve(gram.sum(0), score.sum(0), found.variance)[0] for gram, score in asks]
        found.fields = [_moved(near, mean, w) for near, mean, w in zip(known, amounts, waves, strict=True)]
        found.across = []
        for (gram, score), near, w, first in zip(asks, known, waves, halves, strict=True):
            one, other = (_moved(near, _solve(g, s, found.variance)[0], w) for g, s in zip(gram, score, strict=True))
            found.across.append((torch.where(first, other[0], one[0]), torch.where(first, other[1], one[1])))
    return found


def _scatter(asks: Sequence[tuple[Tensor, Tensor]], variance: Tensor) -> Tensor:
    """Variance of every wave (K,), px2, by expectation-maximisation from a first guess. asks : products of every site, as
    :func:`_equations` has them
    """
    for _ in range(ROUNDS):
        solved = [_solve(gram.sum(0), score.sum(0), variance) for gram, score in asks]
        squares = torch.stack([(mean.square() + spread).mean((0, 1)) for mean, spread in solved])
        variance = squares.mean(0).clamp(min=1e-8)
    return variance


def _in_both_halves(asks: Sequence[tuple[Tensor, Tensor]], variance: Tensor) -> tuple[float, float]:
    """Mean square shift of all waves in both directions, px2, and its standard error over ground.

    variance : (K,) px2 of every wave, for weights. The value may be negative, as an unbiased estimate of nothing is in half of all cases.
    """
    sums = []
    for gram, score in asks:
        inverse = torch.linalg.inv(gram + CAPTURE**-2 * torch.eye(gram.shape[-1]))
        halves = torch.einsum("hnab,hnb->hna", inverse, score)[:, :, 2:].unflatten(2, (2, len(variance)))
        spread = inverse.diagonal(dim1=-2, dim2=-1)[:, :, 2:].unflatten(2, (2, len(variance)))
        weight = 1 / (variance + spread.prod(0).sqrt()).square()
        images = halves.shape[1]
        if images > 1:
            halves = (halves - halves.mean(1, keepdim=True)) * math.sqrt(images / (images - 1))
        sums.append(torch.stack([(weight * halves.prod(0)).sum((0, 1)), weight.sum((0, 1))]))
    every = torch.stack(sums)  # (sites, 2, K)

    def size(of: Tensor) -> float:
        return 2 * float((of[0] / of[1]).sum())

    total = every.sum(0)
    without = np.array([size(total - own) for own in every])
    return size(total), float(jackknife_error(without)) if len(every) > 1 else math.inf


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
    residual, east, south, weight = asked(chain, full_light(chain), field, albedo=True)
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
