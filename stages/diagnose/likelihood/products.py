"""Products of all columns of a piece of ground under the inverse covariance: everything that follows is small linear algebra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.rows.patches import Grid, Patch


@dataclass
class Rows:
    """Coefficients, means and means in deep shadow of one patch: shared (1 + m, n, K) with the residual first, per frame (k, n, K)."""

    patch: Patch
    shared: Tensor
    shared_mean: Tensor
    own: Tensor
    own_mean: Tensor
    shared_dark: Tensor
    own_dark: Tensor


def without_frames(rows: Rows, frames: Sequence[int]) -> Rows | None:
    """The same patch as if these frames had not been taken; None where no image is left."""
    kept = torch.tensor([int(f) not in frames for f in rows.patch.frames])
    if not bool(kept.any()):
        return None
    patch = rows.patch
    by_image = ("images", "weight", "scale", "slopes", "level", "frames", "dark")
    fewer = replace(patch, **{name: getattr(patch, name)[kept] for name in by_image})
    names = ("shared", "shared_mean", "own", "own_mean", "shared_dark", "own_dark")
    return Rows(fewer, *(getattr(rows, name)[:, kept] for name in names))


Residual = tuple[
    Tensor, Tensor, Tensor
]  # coefficients (n, K), means (n,), means in deep shadow (n,); or (R, ...) of each


@dataclass
class Products:
    """Sums over one patch. gram : (M, M), place : (M,) where its columns stand in the whole; sham : (M, R) with sham residuals

    The whole: residual, shared columns, then column by column the frames.
    """

    gram: NDArray[np.float64]
    place: NDArray[np.int64]
    sham: NDArray[np.float64]
    sham_squares: NDArray[np.float64]
    ground: int
    site: int


def whitened_residual(rows: Rows, model: Covariance, grid: Grid) -> Residual:
    """The residual with unit covariance, for shams."""
    factor = _factor(model, rows.patch, grid)
    white = torch.einsum("kij,jk->ik", factor[grid.bins], rows.shared[0])
    mean = torch.linalg.solve_triangular(
        torch.linalg.cholesky(model.mean_matrix(rows.patch)), rows.shared_mean[0].double()[:, None], upper=False
    )
    return white, mean[:, 0], rows.shared_dark[0] / model.dark**0.5


def _real(z: Tensor) -> Tensor:
    """(m, n, K) complex as (m, 2 n K) real ones."""
    return torch.view_as_real(z.contiguous()).flatten(1)


def _factor(model: Covariance, patch: Patch, grid: Grid) -> Tensor:
    """(bins, n, n) complex64: inverse of the lower Cholesky factor."""
    lower = torch.linalg.cholesky(model.matrices(patch, grid))
    return torch.linalg.inv(lower).to(torch.complex64)


def products(rows: Rows, model: Covariance, grid: Grid, frames: int, shams: Residual | None) -> Products:
    """shams : whitened sham residuals."""
    patch = rows.patch
    n = len(patch.frames)
    factor = _factor(model, patch, grid)
    m, k = len(rows.shared), len(rows.own)
    white = torch.empty_like(rows.shared)
    counts = torch.bincount(grid.bins, minlength=len(factor)).tolist()
    own = torch.zeros(k, n, k, n, dtype=torch.float64)
    back = torch.empty_like(rows.shared)
    start = 0
    for b, count in enumerate(counts):
        if not count:
            continue
        at = slice(start, start + count)
        start += count
        white[:, :, at] = factor[b] @ rows.shared[:, :, at]
        back[:, :, at] = factor[b].mH @ white[:, :, at]
        if k:
            x = rows.own[:, :, at].reshape(k * n, count)
            inner = (x @ x.mH).real.double().view(k, n, k, n)
            own += inner * (factor[b].mH @ factor[b]).real.double()[None, :, None]
    flat = _real(white)
    dense = (flat @ flat.T).double()
    cross = torch.zeros(m, 0, n).double()
    if k:
        x_, y_ = (torch.view_as_real(t).flatten(2).transpose(0, 1) for t in (back, rows.own))
        cross = (x_ @ y_.transpose(1, 2)).double().permute(1, 2, 0)
    if not patch.free:
        lower = torch.linalg.cholesky(model.mean_matrix(patch))
        a = torch.linalg.solve_triangular(lower, rows.shared_mean.double().T, upper=False)
        dense += a.T @ a
        inverse = torch.cholesky_inverse(lower)
        if k:
            cross += torch.einsum("mi,in,an->man", rows.shared_mean.double(), inverse, rows.own_mean.double())
            own += torch.einsum("ai,ij,bj->aibj", rows.own_mean.double(), inverse, rows.own_mean.double())
    shadow, own_shadow = (x.double() / model.dark**0.5 for x in (rows.shared_dark, rows.own_dark))
    dense += shadow @ shadow.T
    if k:
        cross += shadow[:, None] * own_shadow
        own += torch.diag_embed(own_shadow[:, None] * own_shadow).permute(0, 2, 1, 3)
    top = torch.cat([dense, cross.flatten(1)], 1)
    low = torch.cat([cross.flatten(1).T, own.reshape(k * n, k * n)], 1)
    place = np.concatenate([np.arange(m), (m + np.arange(k)[:, None] * frames + patch.frames.numpy()[None]).flatten()])
    sham, squares = np.zeros((len(place), 0)), np.zeros(0)
    if shams is not None:
        z, mean, dark = shams
        with_shared = (flat @ _real(z).T).double() + shadow @ dark.double().T
        squares = (z.real.square() + z.imag.square()).sum((1, 2)).double().numpy()
        parts = [with_shared]
        if k:
            spread = torch.empty_like(z)
            start = 0
            for b, count in enumerate(counts):
                at = slice(start, start + count)
                start += count
                if count:
                    spread[:, :, at] = factor[b].mH @ z[:, :, at]
            a_, b_ = (torch.view_as_real(t).flatten(2).transpose(0, 1) for t in (rows.own, spread))
            by_frame = (a_ @ b_.transpose(1, 2)).double().transpose(0, 1)
            parts.append((by_frame + own_shadow[..., None] * dark.double().T).flatten(0, 1))
        if not patch.free:
            parts[0] = parts[0] + a.T @ mean.double().T
            squares = squares + mean.double().square().sum(1).numpy()
            if k:
                upper = torch.linalg.solve_triangular(lower.T, mean.double().T, upper=True)  # (n, R)
                parts[1] = parts[1] + torch.einsum("an,nr->anr", rows.own_mean.double(), upper).flatten(0, 1)
        sham = torch.cat(parts).numpy()
    return Products(torch.cat([top, low]).numpy(), place, sham, squares, patch.ground, patch.site)


def make_shams(white: Sequence[Residual], grid: Grid, count: int, seed: int) -> list[Residual]:
    """Sham residuals for every patch: the whitened residual of another one, its images shuffled, mirrored, of either sign."""
    rng = np.random.default_rng(seed)
    mirror = _mirror(grid)
    out = [
        (torch.empty(count, *z.shape, dtype=z.dtype), torch.empty(count, len(m)), torch.empty(count, len(m)))
        for z, m, _ in white
    ]
    pieces = len(white)
    for r in range(count):
        shift = int(rng.integers(1, pieces)) if pieces > 1 else 0
        for p in range(pieces):
            z, mean, dark = white[(p + shift) % pieces]
            n = len(out[p][0][0])
            images = torch.from_numpy(np.concatenate([rng.permutation(len(z)) for _ in range(-(-n // len(z)))])[:n])
            w = z[images]
            if rng.random() < 0.5:
                w = w[:, mirror]
            if rng.random() < 0.5:
                w = w.conj()
            sign = float(rng.choice([-1.0, 1.0]))
            for into, sham in zip(out[p], (w, mean[images], dark[images]), strict=True):
                into[r] = sign * sham
    return out


def _mirror(grid: Grid) -> Tensor:
    """(K,) index of every wave's mirror image, north for south."""
    columns = grid.width // 2 + 1
    row, column = grid.keep // columns, grid.keep % columns
    flipped = ((grid.height - row) % grid.height) * columns + column
    back = torch.full((grid.height * columns,), 0)
    back[grid.keep] = torch.arange(len(grid.keep))
    return back[flipped]


__all__ = ["Products", "Rows", "make_shams", "products", "whitened_residual"]
