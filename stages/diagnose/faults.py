"""Faults of a detector: what is left varies between the cells of a partition of it by more than chance.

What is left is the whitened residual of each image given the other images of its place. A partition is a way to divide the detector: odd and even
columns, blocks of eight, single lines. Chance is what the same residuals give where the detector's coordinates are scrambled: sheared within
an image, shifted between grounds. One test and one level serve all partitions. Single bright pixels, waves and steps of brightness, which no
partition shows, have tests of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import gammaincinv, stdtrit
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from stages.common.arrays import Floats
from stages.diagnose.data.parallel import per_site
from stages.diagnose.data.sites import Site
from stages.diagnose.judge.state import State, View
from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.intervals import surprise
from stages.diagnose.likelihood.patches import Grid
from stages.diagnose.likelihood.products import Rows, precision, whitened_residual
from stages.diagnose.settings import FAR, FAULTS, FAULTY, FLAT, LINE, NEAR, NOTABLE, PEAK, SPECKS, STANDS_OUT

WITHIN = 0.5  # of the window: nearer to its border a pixel is mostly noise
LARGEST = 5.0  # standard deviations: one pixel tells no more
SCRAMBLES = 20
SHEAR, SHIFT = 0.3, 40.0  # px per px, and px: the largest of a scramble
SIDE = 8  # columns on either side of a seam; of a block of compression (ITU-T T.81)
BROAD = 32  # px, side of the cells of broad fields
LONG = 8  # pixels of a column on a piece of ground, at least
FIRST = 4  # of the waves of a profile: longer ones are ground and film
MOST_PIXELS = 1_000_000
Columns = NDArray[np.int64]


@dataclass
class Innovation:
    """Of one piece of ground. value : (n, h, w) in standard deviations of each image, 0 where ``seen`` is not; seen : (n, h, w) bool

    detector : (n, 2, h, w) line and sample; in the crop where the detector is not known; frames : (n,); site : number of the ground
    """

    value: Tensor
    seen: Tensor
    detector: Tensor
    frames: Tensor
    site: int


def innovations(rows: Sequence[Rows], model: Covariance, grid: Grid, sites: Sequence[Site]) -> list[Innovation]:
    """Residual of each image given all others, whitened, pixel by pixel."""

    def of(row: Rows) -> Innovation:
        patch, z = row.patch, row.shared[0]
        inverse = precision(model, patch, grid)
        own = inverse.diagonal(dim1=-2, dim2=-1).real.sqrt()[grid.bins].T
        given = torch.einsum("kij,jk->ik", inverse[grid.bins], z) / own
        plane = torch.zeros(len(z), grid.height * (grid.width // 2 + 1), dtype=given.dtype)
        plane[:, grid.keep] = given / grid.root
        value = torch.fft.irfft2(plane.unflatten(1, (grid.height, -1)), s=(grid.height, grid.width))
        seen = patch.weight > WITHIN
        value = torch.where(seen, value / patch.weight.clamp(min=WITHIN), 0.0)
        rms = (value.square().sum((-2, -1)) / seen.sum((-2, -1)).clamp(min=1)).sqrt().clamp(min=1e-9)
        detector = sites[patch.site].on_detector()[patch.images][:, :, patch.rows, patch.columns]
        return Innovation(value / rms[:, None, None], seen, detector, patch.frames, patch.site)

    return per_site(of, rows)


@dataclass
class Pixels:
    """What is seen of all images, (N,) each: residual, roughness, line, sample, number of the image of a piece of ground, of the ground, of the frame."""

    value: Floats
    rough: Floats
    line: Floats
    sample: Floats
    image: Columns
    ground: Columns
    frame: Columns

    def scrambled(self, rng: np.random.Generator) -> Pixels:
        """The same with detector coordinates that are sheared within an image and shifted between grounds, and frames in another order on each."""
        shear = rng.uniform(0.1, SHEAR, 2) * rng.choice([-1, 1], 2)
        shift = rng.uniform(-SHIFT, SHIFT, (self.ground.max() + 1, 2))[self.ground]
        line, sample = self.line + shear[0] * self.sample, self.sample + shear[1] * self.line
        order = rng.permuted(np.tile(np.arange(self.frame.max() + 1), (self.ground.max() + 1, 1)), axis=1)
        frame = order[self.ground, self.frame]
        return replace(self, line=line + shift[:, 0], sample=sample + shift[:, 1], frame=frame)


def pixels(every: Sequence[Innovation]) -> Pixels:
    """All that is seen; of many images some."""
    parts, count, image = [], 0, 0
    for one in every:
        rough = _roughness(one)
        for k, frame in enumerate(one.frames.tolist()):
            known = one.seen[k] & one.detector[k].isfinite().all(0)
            number = int(known.sum())
            if not number or count > MOST_PIXELS:
                continue
            fields = one.value[k].clamp(-LARGEST, LARGEST)[known], rough[k][known], *one.detector[k][:, known]
            parts.append(
                [*(x.double().numpy() for x in fields), *(np.full(number, n) for n in (image, one.site, frame))]
            )
            count, image = count + number, image + 1
    if not parts:
        return Pixels(*np.zeros((4, 0)), *np.zeros((3, 0), np.int64))
    return Pixels(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def _roughness(one: Innovation) -> Tensor:
    """(n, h, w) absolute second differences along both axes, over their mean, less one."""
    value = one.value.clamp(-LARGEST, LARGEST)
    total = torch.zeros_like(value)
    total[..., 1:-1] += (value[..., 2:] - 2 * value[..., 1:-1] + value[..., :-2]).abs()
    total[..., 1:-1, :] += (value[..., 2:, :] - 2 * value[..., 1:-1, :] + value[..., :-2, :]).abs()
    mean = (total * one.seen).sum((-2, -1), keepdim=True) / one.seen.sum((-2, -1), keepdim=True).clamp(min=1)
    return total / mean.clamp(min=1e-9) - 1


def between(key: Columns, value: Floats) -> float:
    """Share of the squares that cells have by their means."""
    _, cell = np.unique(key, return_inverse=True)
    total, count = np.bincount(cell, value), np.bincount(cell)
    return float((total**2 / count).sum() / max(float(value @ value), 1e-9))


def alike(key: Columns, ground: Columns, value: Floats) -> float:
    """Share of the squares that different grounds have alike in a cell."""
    pairs, of = np.unique(key * (ground.max(initial=0) + 1) + ground, return_inverse=True)
    _, cell = np.unique(pairs // (ground.max(initial=0) + 1), return_inverse=True)
    own, count = np.bincount(of, value), np.bincount(of)
    total, power, number = np.bincount(cell, own), np.bincount(cell, own**2), np.bincount(cell, count)
    return float(((total**2 - power) / number).sum() / max(float(value @ value), 1e-9))


def _profiles(p: Pixels, along: Floats) -> tuple[Floats, Floats]:
    """(images, L) sums of the residual over each column of the detector, and numbers of pixels."""
    column = np.round(along).astype(np.int64)
    column -= column.min()
    shape = int(p.image.max()) + 1, int(column.max()) + 1
    key = p.image * shape[1] + column
    return tuple(np.bincount(key, w, shape[0] * shape[1]).reshape(shape) for w in (p.value, None))  # type: ignore[return-value]


def seam(p: Pixels, along: Floats) -> float:
    """Share of the squares of the column where images step most, each by its own amount."""
    total, count = (np.cumsum(np.pad(x, ((0, 0), (1, 0))), 1) for x in _profiles(p, along))
    at = np.arange(SIDE, total.shape[1] - SIDE)
    left, right = (count[:, at] - count[:, at - SIDE], count[:, at + SIDE] - count[:, at])
    known = (left > SIDE * LONG) & (right > SIDE * LONG)
    step = (total[:, at] - total[:, at - SIDE]) / np.maximum(left, 1) - (
        total[:, at + SIDE] - total[:, at]
    ) / np.maximum(right, 1)
    share = np.where(known, step**2 * left * right / np.maximum(left + right, 1), 0.0).sum(0)
    often = known.sum(0)
    return float(
        (share / np.maximum(often, 1))[often >= max(often.max(initial=0) // 2, 3)].max(initial=0.0)
        * often.max(initial=0)
        / max(float(p.value @ p.value), 1e-9)
    )


def band(p: Pixels, along: Floats) -> float:
    """Share of the squares of the wave over the detector that all images have most of, at whatever phase."""
    total, count = _profiles(p, along)
    mean = np.where(count >= LONG, total / np.maximum(count, 1), 0.0)
    power = (
        np.abs(np.fft.rfft(mean, axis=1)) ** 2
        * (2 * count.sum(1) / np.maximum((count >= LONG).sum(1), 1) ** 2)[:, None]
    )
    return float(power[:, FIRST:].sum(0).max(initial=0.0) / max(float(p.value @ p.value), 1e-9))


def single(p: Pixels, along: Floats) -> float:
    """Share of the squares of the column that stands out most in all images."""
    total, count = (x.sum(0) for x in _profiles(p, along))
    mean = total / np.maximum(count, 1)
    away = mean - median_filter(mean, 9)
    return float((away**2 * count).max(initial=0.0) / max(float(p.value @ p.value), 1e-9))


def _lines_alone(p: Pixels, along: Floats, across: Floats) -> float:
    """Share of the squares that lines have by their means, about those of the lines near by, alike in both halves of their samples."""
    column = np.round(along).astype(np.int64)
    column -= column.min()
    shape = int(p.image.max()) + 1, int(column.max()) + 1
    middle = np.bincount(p.image, across) / np.maximum(np.bincount(p.image), 1)
    half = across > middle[p.image]
    means, counts = [], []
    for side in (half, ~half):
        key = (p.image * shape[1] + column)[side]
        total, count = (np.bincount(key, w, shape[0] * shape[1]).reshape(shape) for w in (p.value[side], None))
        mean = total / np.maximum(count, 1)
        means.append(mean - median_filter(mean, (1, 9)))
        counts.append(count)
    both = np.minimum(*counts)
    return float(
        (np.where(both >= LONG, means[0] * means[1], 0.0) * sum(counts)).sum() / max(float(p.value @ p.value), 1e-9)
    )


def _parity(p: Pixels, along: Floats) -> float:
    """Share of the squares that alternates from column to column; a pixel halfway between two tells of neither."""
    turn = np.cos(np.pi * along)
    return float((p.value @ turn) ** 2 / max(float(turn @ turn) * float(p.value @ p.value), 1e-9))


def _blocks(p: Pixels, along: Floats) -> float:
    """Share of the squares of roughness that places within blocks of eight have by their means."""
    return between(np.floor(along).astype(np.int64) % SIDE, p.rough)


def _cells(p: Pixels, side: int) -> Columns:
    return np.floor(p.line / side).astype(np.int64) * 1_000_003 + np.floor(p.sample / side).astype(np.int64)


PARTITIONS: dict[str, Callable[[Pixels], float]] = {
    "odd and even columns of the detector that differ": lambda p: max(_parity(p, p.sample), _parity(p, p.line)),
    "edges every eight pixels of the detector, as compression leaves them": lambda p: max(
        _blocks(p, p.sample), _blocks(p, p.line)
    ),
    "a seam between columns of the detector, where each image has a step of its own": lambda p: seam(p, p.sample),
    "a seam between lines of the detector, where each image has a step of its own": lambda p: seam(p, p.line),
    "bands over the columns of the detector, at the same distance in all images": lambda p: band(p, p.sample),
    "bands over the lines of the detector, at the same distance in all images": lambda p: band(p, p.line),
    "single columns of the detector that stand out": lambda p: single(p, p.sample),
    "single lines of the detector that stand out": lambda p: single(p, p.line),
    "lines of the detector that are brighter or darker by themselves, others in every image": lambda p: _lines_alone(
        p, p.line, p.sample
    ),
    "a pattern that stays on the detector whatever ground it shows": lambda p: alike(_cells(p, 2), p.ground, p.value),
    "a broad field in each image that is the same on all ground": lambda p: alike(
        _cells(p, BROAD) + 1_000_000_007 * p.frame, p.ground, p.value
    ),
}


def on_partitions(p: Pixels, seed: int = 0) -> dict[str, float]:
    """Partitions between whose cells what is left varies by more than scrambled coordinates give, and the share of the squares beyond that."""
    out: dict[str, float] = {}
    if not len(p.value):
        return out
    rng = np.random.default_rng(seed)
    by_chance = np.array([[f(q) for f in PARTITIONS.values()] for q in (p.scrambled(rng) for _ in range(SCRAMBLES))])
    rare = float(stdtrit(SCRAMBLES - 1, 1 - FAULTS / len(PARTITIONS)))
    for (words, statistic), chance in zip(PARTITIONS.items(), by_chance.T, strict=True):
        found, roots = statistic(p), np.sqrt(np.maximum(chance, 0.0))  # of shares, which are skewed
        reach = float(roots.mean()) + rare * float(roots.std(ddof=1)) * math.sqrt(1 + 1 / SCRAMBLES)
        if found > max(reach**2, FAULTY + float(chance.mean())):
            out[words] = found - float(chance.mean())
    return out


def faults(state: State, view: View) -> dict[str, float]:
    """What is left that neither ground nor noise has, in words, and its share of the squares."""
    every = innovations(view.rows, view.model, view.grid, state.sites)
    out = on_partitions(pixels(every), state.seed)
    count, share = specks(every)
    if count >= SPECKS and share > FAULTY:
        out[f"{count} single pixels that stand out"] = share
    chance, share, rms = waves(view.rows, view.model, view.grid, state.frames)
    if chance > LINE and rms > FLAT:
        out["lines across an image"] = share
    chance, rms, frame = steps_of_brightness(state.sites, state.frames)
    if chance > LINE:
        weight = torch.bincount(view.grid.annulus, minlength=view.grid.annuli)
        own = float((view.model.own[:, frame] * weight).sum() / weight.sum())
        if (share := rms**2 / own) > NOTABLE:
            out["brightness that comes in equal steps"] = min(share, 1.0)
    return out


NEIGHBOURS = (
    11  # px, side of the square that a pixel is compared with, but for its own 3 x 3, over which images are resampled
)
SEEN_ABOUT = 60  # of its pixels that are seen
BRIGHTEST_NEIGHBOUR = 100.0  # standard deviations of a neighbour: one that stands out itself is no scale


def specks(every: Sequence[Innovation]) -> tuple[int, float]:
    """How many there are, and their share of the squares. A place counts once, in the image that differs most."""
    found, out, total = 0, 0.0, 0.0
    bright, dark = STANDS_OUT
    for one in every:
        ratio = _beside_neighbours(one)
        size = torch.maximum(ratio / bright, -ratio / dark).amax(0)
        peak = size == max_pool2d(size[None], 5, 1, 2)[0]
        odd = peak & (size > 1)
        found += int(odd.sum())
        out += float((one.value.square().amax(0) * odd).sum())
        total += float(one.value.square().sum())
    return found, out / max(total, 1e-9)


def _beside_neighbours(one: Innovation) -> Tensor:
    """(n, h, w) value over the rms of what lies about it, or over the median scatter of its image where that is more."""
    seen = one.seen.float()
    squares = one.value.square().clamp(max=BRIGHTEST_NEIGHBOUR**2)
    about = _sum(squares, NEIGHBOURS) - _sum(squares, 3)
    count = _sum(seen, NEIGHBOURS) - _sum(seen, 3)
    rms = (about / count.clamp(min=1)).clamp(min=0).sqrt()
    middle = torch.stack(
        [v[s].abs().median() if s.any() else v.new_ones(()) for v, s in zip(one.value, one.seen, strict=True)]
    )
    ratio = one.value / torch.maximum(rms, 1.4826 * middle[:, None, None]).clamp(min=1e-9)
    return torch.where(one.seen & (count >= SEEN_ABOUT), ratio, 0.0)


def _sum(x: Tensor, side: int) -> Tensor:
    return avg_pool2d(x[:, None], side, 1, side // 2)[:, 0] * side**2


def waves(rows: Sequence[Rows], model: Covariance, grid: Grid, frames: int) -> tuple[float, float, float]:
    """-log10 of the chance of the strongest single wave of any frame among all of them, its share of that frame's squares, and
    its rms relative to brightness.
    """
    power, plain = torch.zeros(2, frames, len(grid.keep), dtype=torch.float64)
    count, pixels = torch.zeros(2, frames, dtype=torch.float64)
    for row in rows:
        z, _, _ = whitened_residual(row, model, grid)
        size = (row.patch.weight.square().mean((-2, -1)) * model.size.get(row.patch.number, 1.0)).clamp(min=1e-6)
        power.index_add_(0, row.patch.frames, (z.abs().square() / size[:, None]).double())
        plain.index_add_(0, row.patch.frames, row.shared[0].abs().square().double())
        count.index_add_(0, row.patch.frames, torch.ones(len(size), dtype=torch.float64))
        pixels.index_add_(0, row.patch.frames, row.patch.weight.square().sum((-2, -1)).double())
    seen = torch.nonzero(count)[:, 0]
    # broad waves are ground and film; images that were resampled have next to nothing in the corners
    fine = (grid.annulus >= 2) & (torch.hypot(*grid.waves) <= 0.5)
    best, share, rms = 0.0, 0.0, 0.0
    for frame in seen.tolist():
        p, n = power[frame], float(count[frame])
        level = torch.stack([p[grid.annulus == a].median() for a in range(grid.annuli)])
        ratio = p / level[grid.annulus].clamp(min=1e-30)
        ratio = torch.where(fine, ratio / _about(ratio, grid).clamp(min=1), 0.0)
        top, shape = float(ratio.max()), max(n, 1.0)
        chance = float(surprise(np.array([2 * top * float(gammaincinv(shape, 0.5))]), 2 * shape)[0])
        chance -= math.log10(int(fine.sum()) * len(seen))
        # neighbours share a wave through the window: what stands out by a little is no line
        if top > PEAK and chance > best:
            line = ratio > PEAK
            # the ground has its part of every wave
            squares = float((plain[frame] - _about(plain[frame], grid)).clamp(min=0)[line].sum())
            best, share = chance, float(p[line].sum() / p.sum())
            rms = math.sqrt(squares / max(float(pixels[frame]), 1.0))
    return best, share, rms


def _about(power: Tensor, grid: Grid) -> Tensor:
    """(K,) median power of the waves some way off each one: slanting light and optics make power go with direction, in no line."""
    columns = grid.width // 2 + 1
    row, column = grid.keep // columns, grid.keep % columns
    plane = np.full((grid.height, grid.width), float(power.median()))
    plane[row, column] = power
    plane[-row % grid.height, -column % grid.width] = power
    y, x = np.ogrid[-FAR : FAR + 1, -FAR : FAR + 1]
    ring = (np.hypot(y, x) <= FAR) & (np.hypot(y, x) > NEAR)
    return torch.from_numpy(median_filter(plane, footprint=ring, mode="wrap")[row, column])


BINS = 8192  # of the histogram
BRIGHTEST = 4.0  # times the mean: a histogram ends there
WIDEST = 1 / 30  # of the mean: a step of more is a shape of the histogram
FINEST = 1 / 600  # of the mean
WAVES_ABOUT = (
    513  # waves of the histogram's spectrum that a peak is compared with: it is as wide as the histogram is narrow
)


def steps_of_brightness(sites: Sequence[Site], frames: int) -> tuple[float, float, int]:
    """-log10 of the chance of the strongest wave in the histogram of any frame's pixels, and what such steps are rms, relative to its mean; which frame (-1: none).

    Flat ground keeps the levels of a detector wherever resampling mixes equal pixels; smooth brightness has a smooth histogram. The same is
    sought in the root of brightness, in which cameras that compress (compand) their numbers have equal steps.
    """
    best, size, which = 0.0, 0.0, -1
    for frame in range(frames):
        pixels = [s.read[k][s.read_valid[k]] for s in sites for k in np.flatnonzero(s.frames == frame)]
        values = torch.cat(pixels).numpy() if pixels else np.zeros(0)
        mean = float(values.mean()) if len(values) else 0.0
        if not mean > 0:
            continue
        relative = values / mean
        for scaled, per_step in ((relative, 1.0), (np.sqrt(np.maximum(relative, 0.0)), 2.0)):
            chance, step = _strongest(scaled)
            chance -= math.log10(2 * frames)
            if chance > best:
                best, size, which = chance, per_step * step / math.sqrt(12), frame
    return best, size, which


def _strongest(values: NDArray[np.floating]) -> tuple[float, float]:
    """-log10 of the chance of the strongest wave in a histogram of values about 1, and its length."""
    per_unit = np.arange(BINS // 2 + 1) / BRIGHTEST  # cycles per mean brightness
    sought = (per_unit > 1 / WIDEST) & (per_unit < 1 / FINEST)
    counts = np.histogram(values, BINS, (0.0, BRIGHTEST))[0]
    power = np.abs(np.fft.rfft(counts)) ** 2 / max(counts.sum(), 1)  # of chance alone exponential, with mean 1
    excess = np.where(sought, power / np.maximum(median_filter(power, WAVES_ABOUT) / math.log(2), 1.0), 0.0)
    top = int(excess.argmax())
    return float(excess[top] / math.log(10) - math.log10(sought.sum())), 1 / max(float(per_unit[top]), 1e-9)


__all__ = [
    "PARTITIONS",
    "Innovation",
    "Pixels",
    "faults",
    "innovations",
    "on_partitions",
    "pixels",
    "specks",
    "steps_of_brightness",
    "waves",
]
