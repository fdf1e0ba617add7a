"""Products of all columns of a piece of ground under the inverse covariance: everything that follows is small linear algebra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.patches import Grid, Patch

Array = NDArray[np.float64]


@dataclass
class Rows:
    """Coefficients and means of one patch, shared (1 + m, n, K) with the residual first, per frame (k, n, K); means of cells of deep shadow (1 + m, s).

    What has a value per frame is in proportion to light, and brings none into the dark.
    """

    patch: Patch
    shared: Tensor
    shared_mean: Tensor
    own: Tensor
    own_mean: Tensor
    shared_dark: Tensor


Residual = tuple[
    Tensor, Tensor, Tensor
]  # coefficients (n, K), means (n,), means in deep shadow (s,); or (R, ...) of each


@dataclass
class Products:
    """Sums over one patch. gram : (M, M), place : (M,) where its columns stand in the whole; sham : (M, R) with sham residuals

    images : for every group of images (M, M), what is gone from ``gram`` without them: the squares of these images given the others
    The whole: residual, shared columns, then column by column the frames, then the light of its own in the shadows of every frame.
    """

    gram: Array
    place: NDArray[np.int64]
    sham: Array
    sham_squares: Array
    site: int
    images: list[Array] = field(default_factory=list)
    level: Products | None = None  # of the means alone

    def without(self, group: int) -> Products:
        """The sums as if a group of images had not been taken."""
        return replace(self, gram=self.gram - self.images[group], images=[], level=None)


def whitened_residual(rows: Rows, model: Covariance, grid: Grid) -> Residual:
    """The residual with unit covariance, for shams."""
    factor = _factor(model, rows.patch, grid)
    white = torch.einsum("kij,jk->ik", factor[grid.bins], rows.shared[0])
    about = rows.shared_mean[0].double() - (0 if model.level is None else model.level[rows.patch.frames])
    lower = torch.linalg.cholesky(model.mean_matrix(rows.patch))
    mean = torch.linalg.solve_triangular(lower, about[:, None], upper=False)
    dark = model.dark_rest.get(rows.patch.number, rows.shared_dark[0])
    dark = torch.linalg.solve_triangular(model.dark_root(rows.patch), dark.double()[:, None], upper=False)
    return white, mean[:, 0], dark[:, 0]


def _by_wave(z: Tensor) -> Tensor:
    """(m, n, K) complex as (2 K, n, m): real parts of all waves, then imaginary ones."""
    return torch.cat([z.real, z.imag], -1).permute(2, 1, 0).contiguous()


def _factor(model: Covariance, patch: Patch, grid: Grid) -> Tensor:
    """(bins, n, n) complex64: inverse of the lower Cholesky factor."""
    lower = torch.linalg.cholesky(model.matrices(patch, grid))
    return torch.linalg.inv(lower).to(torch.complex64)


def precision(model: Covariance, patch: Patch, grid: Grid) -> Tensor:
    """(bins, n, n) complex64: inverse of the covariance of the images."""
    factor = _factor(model, patch, grid)
    return factor.mH @ factor


def products(
    rows: Rows,
    model: Covariance,
    grid: Grid,
    frames: int,
    shams: Residual | None = None,
    groups: Sequence[Sequence[int]] = (),
) -> Products:
    """shams : whitened sham residuals; groups : of frames, each to be left out once."""
    patch = rows.patch
    columns = _Columns(rows, model, grid, bool(groups))
    factor = _factor(model, patch, grid).real
    mean = None if patch.free else torch.linalg.inv(torch.linalg.cholesky(model.mean_matrix(patch)))
    every = torch.ones(len(patch.dark_frames), dtype=torch.float64)
    gram = columns.gram(factor, mean, every)
    m, k = len(rows.shared), len(rows.own)
    place = np.concatenate(
        [
            np.arange(m),
            (m + np.arange(k)[:, None] * frames + patch.frames.numpy()[None]).flatten(),
            m + k * frames + columns.own_dark_frames.numpy(),
        ]
    )
    sham, squares = np.zeros((len(place), 0)), np.zeros(0)
    if shams is not None:
        sham, squares = columns.beside(shams, factor, mean)
    level = None if mean is None else _of_means(rows, mean, place[: m + k * len(patch.frames)], shams)
    parts = []
    for group in groups:
        gone, darker = (
            torch.tensor([int(f) in group for f in frames], dtype=torch.bool)
            for frames in (patch.frames, patch.dark_frames)
        )
        part = np.zeros_like(gram)
        if bool(gone.any() | darker.any()):
            rest = None if mean is None else _given_others(mean[None], gone)[0]
            part = columns.gram(_given_others(factor, gone), rest, darker.double())
            light = np.isin(columns.own_dark_frames, group)
            own = np.concatenate([np.zeros(m, bool), np.tile(gone.numpy(), k), light])
            part[own], part[:, own] = gram[own], gram[:, own]  # to the last bit: nothing is left of them
        parts.append(part)
    return Products(gram, place, sham, squares, patch.site, parts, level)


def _of_means(rows: Rows, mean: Tensor, place: NDArray[np.int64], shams: Residual | None) -> Products:
    """The products of the patch's means alone, whitened by ``mean`` (n, n)."""
    shared = rows.shared_mean.double() @ mean.T
    own = torch.einsum("rn,kn->knr", mean, rows.own_mean.double()).flatten(0, 1)
    every = torch.cat([shared, own])
    means = shams[1].double() if shams is not None else every[:0]
    sham = (every @ means.T).numpy()
    return Products((every @ every.T).numpy(), place, sham, means.square().sum(1).numpy(), rows.patch.site)


def _given_others(factor: Tensor, gone: Tensor) -> Tensor:
    """(B, g, n) whitening of some images given the others, of (B, n, n) whitening of all: by the Schur complement of the precision."""
    precision = factor.mT.double() @ factor.double()
    lower = torch.linalg.cholesky(precision[:, gone][:, :, gone])
    return torch.linalg.solve_triangular(lower, precision[:, gone], upper=False).to(factor.dtype)


class _Columns:
    """The columns of one patch, ready for products under several weights.

    Real and imaginary parts count as waves of their own, (2 K, n, m): a product over waves and images is one matrix product.
    """

    def __init__(self, rows: Rows, model: Covariance, grid: Grid, often: bool) -> None:
        self.rows, self.of_wave = rows, grid.bins.repeat(2)
        self.bins = torch.unique(grid.bins)
        self.k = len(rows.own)
        # light of its own of every image, in units of its standard deviation
        cells, root = rows.patch.dark_frames, model.dark_root(rows.patch)
        self.dark = torch.linalg.solve_triangular(root, rows.shared_dark.double().T, upper=False).T
        self.own_dark_frames = torch.unique(cells) if model.dark_own else cells[:0]
        own = (self.own_dark_frames == cells[:, None]).double() * model.dark_own**0.5
        self.own_dark = torch.linalg.solve_triangular(root, own, upper=False).T
        self.shared = _by_wave(rows.shared)
        self.own = _by_wave(rows.own)
        n = rows.own.shape[1]
        self.inner = self.across = torch.zeros(
            0
        )  # of each bin: own columns among themselves, and beside the shared ones
        if self.k:
            inner, across = [], []
            for b in self.bins:
                of = slice(*torch.searchsorted(grid.bins, torch.stack([b, b + 1])).tolist())
                x = rows.own[:, :, of].reshape(self.k * n, -1)
                inner.append((x @ x.mH).real)
                if often:
                    across.append((rows.shared[:, :, of].flatten(0, 1) @ x.mH).real)
            self.inner = torch.stack(inner).double().view(-1, self.k, n, self.k, n)
            if often:
                self.across = torch.stack(across).double().view(len(inner), -1, n, self.k, n)

    def gram(self, factor: Tensor, mean: Tensor | None, shaded: Tensor) -> Array:
        """(M, M) of all columns, whitened by ``factor`` (B, r, n) and, their means, by (r, n); shaded : (s,) 1 where deep shadow counts."""
        rows, k = self.rows, self.k
        n, m = factor.shape[-1], len(rows.shared)
        by_wave = factor[self.of_wave].to(self.shared.dtype)
        white = (by_wave @ self.shared).flatten(0, 1)
        dense = (white.T @ white).double()
        cross = torch.zeros(m, k, n, dtype=torch.float64)
        own = torch.zeros(k, n, k, n, dtype=torch.float64)
        if k:
            precision = (factor[self.bins].mT @ factor[self.bins]).double()
            own = (self.inner * precision[:, None, :, None]).sum(0)
            if len(self.across):
                cross = torch.einsum("bmrkn,brn->mkn", self.across, precision)
            else:
                cross = (white.T @ self._own(by_wave)).double().view(m, n, k).mT
        if mean is not None:
            shared, others = rows.shared_mean.double() @ mean.T, mean.T @ mean
            dense += shared @ shared.T
            cross = cross + (shared @ mean)[:, None] * rows.own_mean.double()
            own += torch.einsum("ai,ij,bj->aibj", rows.own_mean.double(), others, rows.own_mean.double())
        dense += self.shade(shaded)
        top = torch.cat([dense, cross.flatten(1)], 1)
        low = torch.cat([cross.flatten(1).T, own.reshape(k * n, k * n)], 1)
        lit = torch.cat([top, low])
        light = self.own_dark * shaded
        across_light = torch.zeros(len(light), len(lit), dtype=torch.float64)
        across_light[:, :m] = light @ self.dark.T
        return torch.cat([torch.cat([lit, across_light.T], 1), torch.cat([across_light, light @ light.T], 1)]).numpy()

    def _own(self, by_wave: Tensor) -> Tensor:
        """(2 K r, n k) the columns of every frame, whitened by (2 K, r, n)."""
        return (by_wave.unsqueeze(-1) * self.own.unsqueeze(1)).flatten(2).flatten(0, 1)

    def shade(self, shaded: Tensor) -> Tensor:
        """(1 + m, 1 + m) of the shared columns' means in deep shadow; shaded : (s,) 1 where it counts."""
        return (self.dark * shaded) @ self.dark.T

    def beside(self, shams: Residual, factor: Tensor, mean: Tensor | None) -> tuple[Array, Array]:
        """Products (M, R) of all columns with whitened sham residuals, and the squares of these, (R,)."""
        rows = self.rows
        z, means, dark = shams
        by_wave = factor[self.of_wave].to(self.shared.dtype)
        white, sham = (by_wave @ self.shared).flatten(0, 1), _by_wave(z).flatten(0, 1)
        first = (white.T @ sham).double()
        first += self.dark @ dark.double().T
        n, k = rows.own.shape[1], self.k
        second = (self._own(by_wave).T @ sham).double().view(n, k, sham.shape[1]).transpose(0, 1)
        squares = (z.real.square() + z.imag.square()).sum((1, 2)).double()
        if mean is not None:
            first += rows.shared_mean.double() @ mean.T @ means.double().T
            second += torch.einsum("an,nr->anr", rows.own_mean.double(), mean.T @ means.double().T)
            squares += means.double().square().sum(1)
        return torch.cat([first, second.flatten(0, 1), self.own_dark @ dark.double().T]).numpy(), squares.numpy()


class Shams:
    """Sham residuals for every patch: the whitened residual of another one, its images shuffled, mirrored, of either sign.

    Only how each is made is kept: all of them together would be ``count`` times as large as the data.
    """

    def __init__(self, white: Sequence[Residual], grid: Grid, count: int, seed: int) -> None:
        self.white, self.mirror = white, _mirror(grid)
        rng = np.random.default_rng(seed)
        pieces = len(white)
        shadows = np.concatenate([d.numpy() for _, _, d in white])
        # of every sham and piece: means in deep shadow, whose residual, its images, mirrored, conjugate, sign
        self.made: list[list[tuple[Tensor, int, Tensor, bool, bool, float]]] = []
        for _ in range(count):
            drawn = torch.from_numpy(rng.permutation(shadows)).split([len(d) for _, _, d in white])
            shift = int(rng.integers(1, pieces)) if pieces > 1 else 0
            made = []
            for p, (own, _, _) in enumerate(white):
                other = (p + shift) % pieces
                images = len(white[other][0])
                order = np.concatenate([rng.permutation(images) for _ in range(-(-len(own) // images))])[: len(own)]
                flips = rng.random() < 0.5, rng.random() < 0.5
                made.append((drawn[p], other, torch.from_numpy(order), *flips, float(rng.choice([-1.0, 1.0]))))
            self.made.append(made)

    def of(self, piece: int) -> Residual:
        """All shams of one patch."""
        z, means, dark = [], [], []
        for made in self.made:
            drawn, other, order, mirrored, conjugate, sign = made[piece]
            wave, mean = (x[order] for x in self.white[other][:2])
            if mirrored:
                wave = wave[:, self.mirror]
            z.append(sign * (wave.conj() if conjugate else wave))
            means.append(sign * mean)
            dark.append(sign * drawn)
        return torch.stack(z), torch.stack(means).float(), torch.stack(dark).float()


def _mirror(grid: Grid) -> Tensor:
    """(K,) index of every wave's mirror image, north for south."""
    columns = grid.width // 2 + 1
    row, column = grid.keep // columns, grid.keep % columns
    flipped = ((grid.height - row) % grid.height) * columns + column
    back = torch.full((grid.height * columns,), 0)
    back[grid.keep] = torch.arange(len(grid.keep))
    return back[flipped]


__all__ = ["Products", "Rows", "Shams", "precision", "products", "whitened_residual"]
