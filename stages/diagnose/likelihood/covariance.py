"""Covariance of the residuals, estimated from them: what the images of a place share, what each has of its own, by wavelength.

For every annulus of spatial frequency  z = 1 a + i (g . k) h + e:  albedo a that all images of the place see alike, relief h that
the DEM has not, which each sees by its own shading g, and what is each image's own, noise included. Variances by
expectation-maximisation (Dempster et al. 1977; factor analysis with known loadings).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.likelihood.patches import Grid, Patch, window
from stages.diagnose.model.chain import Chain
from stages.diagnose.settings import ADDED, BORROWED, DARKEST, ROUNDS, SECTORS


@dataclass
class Covariance:
    """Variances of a wave, relative to brightness squared. albedo, relief : (A,); own : (A, frames); mean_* : of a patch's means about ``level``

    level : (frames,) mean of an image's residual over all patches, which is no noise
    """

    albedo: Tensor
    relief: Tensor
    own: Tensor
    mean_albedo: float
    mean_relief: float
    mean_own: float
    dark: float = 1.0  # of the mean of a cell of deep shadow, about its piece's
    dark_piece: float = 0.0  # of the mean of a piece's cells in one image, about what light explains
    dark_own: float = 0.0  # of light that falls into all deep shadow of one image alone, stray light say
    dark_rest: dict[int, Tensor] = field(default_factory=dict)  # ... and what it leaves of a patch's (by its number)
    level: Tensor | None = None
    size: dict[int, float] = field(default_factory=dict)  # of a patch (by its number), times the above
    mean_size: dict[int, float] = field(default_factory=dict)
    radius: list[float] = field(default_factory=list)  # (A,) cycles/px

    @classmethod
    def white(cls, annuli: int, frames: int) -> Covariance:
        """Every pixel for itself."""
        none = torch.zeros(annuli, dtype=torch.float64)
        return cls(none, none, torch.ones(annuli, frames, dtype=torch.float64), 0.0, 0.0, 1.0)

    def matrices(self, patch: Patch, grid: Grid) -> Tensor:
        """(A * SECTORS, n, n) of the waves of one patch."""
        u = patch.slopes.double() @ grid.direction.double().T  # (n, sectors)
        shape = u.T[:, :, None] * u.T[:, None]  # (sectors, n, n)
        out = self.albedo[:, None, None, None] + self.relief[:, None, None, None] * shape
        own = self.own[:, patch.frames]
        out = out + torch.diag_embed(own)[:, None]
        return out.flatten(0, 1) * self.size.get(patch.number, 1.0)

    def mean_matrix(self, patch: Patch) -> Tensor:
        """(n, n) covariance of the patch's mean among the n images of a site."""
        g = patch.slopes.double()
        own = torch.eye(len(g), dtype=torch.float64) * self.mean_own
        return (self.mean_albedo + self.mean_relief * (g @ g.T) + own) * self.mean_size.get(patch.number, 1.0)

    def dark_root(self, patch: Patch) -> Tensor:
        """(s, s) lower Cholesky factor of the covariance of the cells of deep shadow; those of different images are independent."""
        of = patch.dark_frames
        same = (of[:, None] == of).double()
        return torch.linalg.cholesky(self.dark_piece * same + self.dark * torch.eye(len(of), dtype=torch.float64))


def estimate(patches: Sequence[Patch], rows: Sequence[tuple[Tensor, Tensor]], grid: Grid, frames: int) -> Covariance:
    """From the residual's coefficients (n, K) and means (n,) of every patch."""
    products, counts = [], []
    for patch, (z, _) in zip(patches, rows, strict=True):
        size = patch.weight.square().mean((-2, -1)).sqrt().clamp(min=1e-6)
        scaled = z / size[:, None]
        parts = torch.stack([scaled.real, scaled.imag], -1).double()  # (n, K, 2)
        n = len(z)
        sums = torch.zeros(grid.annuli * SECTORS, n, n, dtype=torch.float64)
        weight = grid.root.double() ** 2 * grid.height * grid.width  # 1 or 2 real waves
        sums.index_add_(0, grid.bins, torch.einsum("ikc,jkc->kij", parts, parts))
        products.append(sums.unflatten(0, (grid.annuli, SECTORS)))
        counts.append(
            torch.zeros(grid.annuli * SECTORS, dtype=torch.float64)
            .index_add_(0, grid.bins, weight)
            .unflatten(0, (grid.annuli, SECTORS))
        )
    share = [float(p.weight.square().mean()) for p in patches]
    total = torch.zeros(grid.annuli, dtype=torch.float64)
    number = torch.zeros(grid.annuli, dtype=torch.float64)
    for s, c in zip(products, counts, strict=True):
        total += s.diagonal(dim1=-2, dim2=-1).sum((1, 2))
        number += c.sum(1) * s.shape[-1]
    level = total / number.clamp(min=1e-9)
    albedo, relief = 0.4 * level, 0.2 * level
    own = 0.4 * level[:, None].expand(-1, frames).clone()
    bends = torch.stack([(p.slopes.double() @ grid.direction.double().T).square().mean() for p in patches]).mean()
    relief = relief / bends.clamp(min=1e-9)
    model = Covariance(albedo, relief, own, 0.0, 0.0, 0.0)
    sizes = {p.number: 1.0 for p in patches}
    for _ in range(ROUNDS):
        fits = {}
        a, r = torch.zeros_like(albedo), torch.zeros_like(relief)
        o, oc = torch.zeros_like(own), torch.zeros_like(own)
        n_ar = torch.zeros_like(albedo)
        for patch, s, c, part in zip(patches, products, counts, share, strict=True):
            sigma = model.matrices(patch, grid).unflatten(0, (grid.annuli, SECTORS))
            inverse = torch.linalg.inv(sigma)
            degrees = float(c.sum()) * len(patch.frames) * part
            fits[patch.number] = (float((inverse * s).sum()) * part + ADDED) / (degrees + ADDED)
            s = s / sizes[patch.number]
            u = (patch.slopes.double() @ grid.direction.double().T).T  # (sectors, n)
            load = torch.stack([torch.ones_like(u), u], -1)  # (sectors, n, 2)
            size = torch.stack([model.albedo, model.relief], -1)  # (A, 2)
            gain = size[:, None, :, None] * (load.transpose(1, 2)[None] @ inverse)  # (A, S, 2, n)
            count = c[..., None, None]
            second = gain @ s @ gain.transpose(-1, -2) + count * (
                torch.diag_embed(size)[:, None] - gain @ load[None] * size[:, None, None, :]
            )
            left = s - 2 * (load[None] @ gain @ s) + load[None] @ second @ load.transpose(1, 2)[None]
            a += second[..., 0, 0].sum(1) * part
            r += second[..., 1, 1].sum(1) * part
            n_ar += c.sum(1) * part
            diagonal = left.diagonal(dim1=-2, dim2=-1).sum(1) * part  # (A, n)
            o.index_add_(1, patch.frames, diagonal)
            oc.index_add_(1, patch.frames, (c.sum(1) * part)[:, None].expand(-1, len(patch.frames)).contiguous())
        common = o.sum(1, keepdim=True) / oc.sum(1, keepdim=True).clamp(min=1e-9)
        own = ((o + BORROWED * common) / (oc + BORROWED)).clamp(min=1e-3 * level[:, None])
        sizes = _unit_mean(fits)
        model = Covariance(
            (a / n_ar.clamp(min=1e-9)).clamp(min=0), (r / n_ar.clamp(min=1e-9)).clamp(min=0), own, 0.0, 0.0, 0.0
        )
    _means(model, patches, [m.double() for _, m in rows], frames)
    model.size, model.radius = sizes, grid.radius.tolist()
    return model


def shadow_variance(
    model: Covariance, patches: Sequence[Patch], residuals: Sequence[Tensor], light: Sequence[Tensor]
) -> None:
    """Set the variances of means in deep shadow, of which relief that the DEM has not lights some, and what light leaves of them.

    residuals : (s,) of every patch; light : (L, s) of every kind that falls there, which is no noise. Pieces differ at least as the cells within one.
    """
    values, kinds = torch.cat(list(residuals)).double(), torch.cat(list(light), 1).double().T
    if not len(values):
        return
    frames = torch.cat([p.dark_frames for p in patches])
    piece = torch.cat([torch.full_like(p.dark_frames, k) for k, p in enumerate(patches)])
    images = (frames[:, None] == torch.unique(frames)).double()
    _, block, cells = torch.unique(torch.stack([piece, frames]), dim=1, return_inverse=True, return_counts=True)
    blocks = len(cells)

    def means(x: Tensor) -> Tensor:
        """Over the cells of a piece in one image."""
        summed = torch.zeros(blocks, *x.shape[1:], dtype=x.dtype).index_add_(0, block, x)
        return torch.einsum("b...,b->b...", summed, 1 / cells.to(x.dtype))

    rest, free = values, 0
    for columns, asked in ((torch.cat([kinds, images], 1), 2), (images, 1)):  # each image may have light of its own
        of_pieces = means(columns)
        rank = int(torch.linalg.matrix_rank(of_pieces))
        if blocks > asked * rank:
            fitted = torch.linalg.lstsq(of_pieces, means(values)[:, None], driver="gelsd").solution
            rest, free = values - (columns @ fitted)[:, 0], rank
            break
    about = rest - means(rest)[block]
    several = len(values) - blocks
    within = float(about.square().sum()) / several if several else 0.0
    between = float(means(rest).square().sum()) / (blocks - free) if free or not several else within
    model.dark, model.dark_piece = max(within or between, 1e-10), max(within, between, 1e-10)
    model.dark_rest = {p.number: r for p, r in zip(patches, rest.split([len(r) for r in residuals]), strict=True)}
    model.dark_own = model.mean_own / DARKEST**2  # lit ground tells how much of their own images have


def _unit_mean(sizes: dict[int, float]) -> dict[int, float]:
    """Sizes over their geometric mean."""
    middle = math.exp(sum(math.log(v) for v in sizes.values()) / len(sizes))
    return {k: v / middle for k, v in sizes.items()}


def _means(model: Covariance, patches: Sequence[Patch], means: Sequence[Tensor], frames: int) -> None:
    """Variances of the patches' mean brightness, likewise, about a level of each image that all patches share.

    What acts on an image as a whole is to be told from what differs from patch to patch, and must not pass for it.
    """
    everything = torch.cat(list(means))
    level = max(float(everything.square().mean()), 1e-12)
    albedo, relief, own = 0.5 * level, 0.1 * level, 0.4 * level
    sizes = {p.number: 1.0 for p in patches}
    shared = torch.zeros(frames, dtype=torch.float64)
    seen = torch.bincount(torch.cat([p.frames for p in patches]), minlength=frames).clamp(min=1)
    for _ in range(ROUNDS):
        fits: dict[int, float] = {}
        sums = [0.0, 0.0, 0.0]
        numbers = [0.0, 0.0, 0.0]
        asked = torch.zeros_like(shared)
        for patch, m in zip(patches, means, strict=True):
            m = m - shared[patch.frames]
            load = torch.cat([torch.ones(len(m), 1, dtype=torch.float64), patch.slopes.double()], 1)
            size = torch.tensor([albedo, relief, relief], dtype=torch.float64)
            sigma = (load * size) @ load.T + own * torch.eye(len(m), dtype=torch.float64)
            inverse = torch.linalg.inv(sigma)
            fits[patch.number] = (float(m @ inverse @ m) + 5.0) / (len(m) + 5.0)
            scale = math.sqrt(sizes[patch.number])
            m = m / scale
            gain = (size[:, None] * load.T) @ inverse
            mean = gain @ m
            second = torch.outer(mean, mean) + torch.diag(size) - gain @ load * size
            rest = m - load @ mean
            asked.index_add_(0, patch.frames, rest * scale)
            sums[0] += float(second[0, 0])
            sums[1] += float(second[1, 1] + second[2, 2])
            sums[2] += float(rest @ rest + ((load @ (torch.diag(size) - gain @ load * size)) * load).sum())
            numbers[0] += 1
            numbers[1] += 2
            numbers[2] += float((1 - 1 / seen[patch.frames]).sum())  # a level is fitted to each image
        shared = shared + asked / seen
        sizes = _unit_mean(fits)
        albedo, relief, own = (max(s / max(k, 1), 1e-4 * level) for s, k in zip(sums, numbers, strict=True))
    model.mean_albedo, model.mean_relief, model.mean_own = albedo, relief, own
    model.mean_size, model.level = sizes, shared


def kept_share(
    chains: Sequence[Chain], patches: Sequence[Sequence[Patch]], grid: Grid, frames: int
) -> Callable[[Tensor], Tensor]:
    """Share of the DEM's waves, by their number in rad/px, that is relief if all that images show beside it is errors of the DEM.

    A DEM that is off by e predicts shading that is not there, and images show it as relief -e: the rendering is too rough where errors are a
    good part of the relief (errors in variables: Fuller 1987, Measurement error models).
    """
    every: list[Patch] = []
    left: list[tuple[Tensor, Tensor]] = []
    for chain, pieces in zip(chains, patches, strict=True):
        residual = (chain.site.image - chain.rendered)[None]
        for patch in pieces:
            z, mean = patch.transform(residual, grid)
            every.append(patch)
            left.append((z[0], mean[0]))
    model = estimate(every, left, grid, frames)
    total = torch.zeros(grid.annuli, dtype=torch.float64)
    waves = torch.bincount(grid.annulus, minlength=grid.annuli)
    taper = window(grid.height, grid.width)
    along = grid.direction[grid.sector].T
    for patch in every:
        here = torch.stack([s[0, patch.rows, patch.columns] for s in chains[patch.site].state.slopes])
        z = torch.fft.rfft2((here - here.mean((-2, -1), keepdim=True)) * taper).flatten(-2)[:, grid.keep]
        power = (z * along).sum(0).abs().square().double() / (here[0].numel() * float(taper.square().mean()))
        total.index_add_(0, grid.annulus, power)
    dem = total / (waves * max(len(every), 1))
    share = (1 - model.relief / dem.clamp(min=1e-30)).clamp(0, 1)
    radius = 2 * np.pi * np.asarray(model.radius)

    def kept(waves: Tensor) -> Tensor:
        return torch.from_numpy(np.interp(waves.numpy(), radius, share.numpy())).to(waves)

    return kept


__all__ = ["Covariance", "estimate", "kept_share", "shadow_variance"]
