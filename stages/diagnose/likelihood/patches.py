"""Pieces of ground, seen through a window: relative residuals and templates as Fourier coefficients."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import lit_mask
from stages.diagnose.settings import (
    CELL,
    CLEAR,
    DARKEST,
    FEWEST_PIXELS,
    LIT_MARGIN,
    PATCH,
    RUGGED,
    SECTORS,
    SHADOWED,
    TAPER,
    UNITS,
    USUAL,
)


@dataclass(frozen=True)
class Grid:
    """Waves of a patch: which coefficients of ``rfft2`` are kept, how often each counts, and its annulus and sector.

    keep : (K,) indices; root : (K,) root of how often a wave counts over the number of pixels
    annulus, sector : (K,) numbers; direction : (SECTORS, 2) unit vectors east, north; radius : (A,) cycles/px, mean
    """

    height: int
    width: int
    keep: Tensor
    root: Tensor
    annulus: Tensor
    sector: Tensor
    direction: Tensor
    radius: Tensor

    @property
    def annuli(self) -> int:
        """Rings of equal spatial frequency."""
        return len(self.radius)

    @cached_property
    def waves(self) -> tuple[Tensor, Tensor]:
        """(K,) cycles/px down the rows and along the columns."""
        columns = self.width // 2 + 1
        return torch.fft.fftfreq(self.height)[self.keep // columns], torch.fft.rfftfreq(self.width)[self.keep % columns]

    @cached_property
    def bins(self) -> Tensor:
        """(H, W) number of the ring and sector that each frequency belongs to."""
        return self.annulus * SECTORS + self.sector


def make_grid(height: int, width: int) -> Grid:
    """Annuli grow by half an octave, the first ones by single waves."""
    ky = torch.fft.fftfreq(height)[:, None].expand(height, width // 2 + 1)
    kx = torch.fft.rfftfreq(width).expand_as(ky)
    twice = torch.full_like(kx, 2.0)
    twice[:, 0] = 1.0
    if width % 2 == 0:
        twice[:, -1] = 1.0
    radius = torch.hypot(kx, ky) * math.sqrt(height * width)  # waves per patch
    keep = torch.nonzero(radius.flatten() > 0.5)[:, 0]
    r = radius.flatten()[keep]
    edges = [1.5, 2.5, 4.0]
    while edges[-1] < float(r.max()):
        edges.append(edges[-1] * math.sqrt(2))
    annulus = torch.bucketize(r, torch.tensor(edges[:-1]))
    # image rows run south
    angle = torch.atan2(-ky.flatten()[keep], kx.flatten()[keep]) % math.pi
    sector = (angle / math.pi * SECTORS).long().clamp(max=SECTORS - 1)
    middle = (torch.arange(SECTORS) + 0.5) * math.pi / SECTORS
    direction = torch.stack([middle.cos(), middle.sin()], 1)
    count = int(annulus.max()) + 1
    mean = torch.zeros(count).index_add_(0, annulus, r) / torch.bincount(annulus, minlength=count).clamp(min=1)
    order = torch.argsort(annulus * SECTORS + sector, stable=True)  # waves of a bin lie together
    keep, annulus, sector, r = keep[order], annulus[order], sector[order], r[order]
    root = (twice.flatten()[keep] / (height * width)).sqrt()
    return Grid(height, width, keep, root, annulus, sector, direction, mean / math.sqrt(height * width))


@dataclass
class Patch:
    """One piece of one site. weight : (n, h, w) window on judged pixels; scale : (n, h, w), I/F that residuals are relative to

    images : (n,) which of the site's images; slopes : (n, 2) relative brightness per slope to the east and north
    shaded : (d,) which of the site's images show deep shadow, lit ground beside it or not
    dark_frames : (s,) of every cell of deep shadow
    dark, cell : (d, h, w) by which a field is multiplied to add up to its means in the cells, relative to brightness; in which one a pixel is
    middle : (n, 2) line and sample of the detector that its middle falls on; in the crop where the detector is not known
    """

    number: int
    site: int
    images: Tensor
    rows: slice
    columns: slice
    weight: Tensor
    scale: Tensor
    slopes: Tensor
    level: Tensor
    frames: Tensor
    shaded: Tensor
    dark_frames: Tensor
    dark: Tensor
    cell: Tensor
    middle: Tensor
    free: bool  # gain and offset of every image

    def relative(self, fields: Tensor) -> Tensor:
        """Fields (m, N, H, W) of the site as relative ones of the patch, free of each image's mean (gain and offset), windowed."""
        x = fields[:, self.images, self.rows, self.columns] / self.scale
        return x

    def shadow(self, fields: Tensor) -> Tensor:
        """Means of relative fields (m, N, H, W) in cells of deep shadow, (m, s)."""
        pixels = fields[:, self.shaded, self.rows, self.columns] * self.dark
        out = torch.zeros(len(fields), len(self.dark_frames), dtype=pixels.dtype)
        return out.index_add_(1, self.cell.flatten(), pixels.flatten(1))

    def transform(self, fields: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        """Fields (m, N, H, W) -> coefficients (m, n, K) complex and means (m, n)."""
        x = self.relative(fields)
        if not len(x):
            return torch.zeros(*x.shape[:2], len(grid.keep), dtype=torch.complex64), torch.zeros(x.shape[:2])
        w = self.weight
        total = w.sum((-2, -1)).clamp(min=1e-9)
        mean = (x * w).sum((-2, -1)) / total
        x = x - mean[..., None, None]
        if self.free:
            bright = self.level
            x = (
                x
                - ((x * bright * w).sum((-2, -1)) / (bright * bright * w).sum((-2, -1)).clamp(min=1e-9))[
                    ..., None, None
                ]
                * bright
            )
        z = torch.fft.rfft2(x * w).flatten(-2)[..., grid.keep] * grid.root
        return z, mean


def judged(chain: Chain) -> tuple[Tensor, Tensor]:
    """Two (n, H, W) bool: ground with the Sun well above its own slopes and the horizon; ground in deep shadow a pixel away from its edge.

    Elsewhere relief below the DEM's resolution decides what is lit.
    """
    own = torch.asin(chain.state.angles.cos_incidence.clamp(-1, 1))
    above = chain.height_above_horizon()
    east, north = chain.state.slopes
    rugged = math.atan(float((east.square() + north.square()).mean().sqrt()))
    clear = max(CLEAR, RUGGED * rugged)
    lit = lit_mask(chain) & (own > clear)
    if above is None:
        return lit, torch.zeros_like(lit)
    deep = (above < -LIT_MARGIN).float()
    deep = -torch.nn.functional.max_pool2d(-deep[:, None], 3, 1, 1)[:, 0]
    return lit & (above > clear), (deep > 0) & chain.site.valid


def window(height: int, width: int) -> Tensor:
    """Cosine taper (Tukey) at the borders, (h, w)."""

    def side(count: int) -> Tensor:
        u = (torch.arange(count) + 0.5) / count
        edge = torch.minimum(u, 1 - u) / TAPER
        return torch.where(edge < 1, 0.5 - 0.5 * torch.cos(math.pi * edge), 1.0)

    return side(height)[:, None] * side(width)


def cuts(size: int, sites: int) -> int:
    """Into how many pieces a side is cut, so that there are enough pieces of ground for a jackknife."""
    need = math.ceil(math.sqrt(UNITS / max(sites, 1)))
    return max(1, min(need, size // PATCH))


def make_patches(number: int, chain: Chain, pieces: int, free: bool) -> list[Patch]:
    """The pieces of one site that show enough pixels."""
    use, deep = judged(chain)
    image = chain.predict()
    _, height, width = image.shape
    lit = lit_mask(chain)
    kept = torch.tensor([k not in chain.site.left_out for k in range(len(image))])
    level = (image * lit).sum((-2, -1)) / lit.sum((-2, -1)).clamp(min=1)
    scale = torch.maximum(image, DARKEST * level[:, None, None]).clamp(min=1e-6)
    # what is bright all the same is lit ground that the DEM does not know of
    deep = _without_lit(deep & (chain.site.image < DARKEST * level[:, None, None]), chain.site.image)
    east, north = chain.slope_tangents
    detector = chain.site.on_detector()
    h, w = height // pieces, width // pieces
    out = []
    for i in range(pieces):
        for j in range(pieces):
            rows, columns = slice(i * h, (i + 1) * h), slice(j * w, (j + 1) * w)
            here = use[:, rows, columns]
            seen = (here & lit[:, rows, columns]).sum((-2, -1))
            images = torch.nonzero((seen >= min(FEWEST_PIXELS, 0.3 * h * w)) & (level > 0) & kept)[:, 0]
            if not len(images):
                continue
            weight = here[images].float() * window(h, w)
            s = scale[images, rows, columns]
            total = weight.sum((-2, -1)).clamp(min=1e-9)
            slopes = torch.stack(
                [((t[images, rows, columns] / s) * weight).sum((-2, -1)) / total for t in (east, north)], 1
            )
            bright = 1 / s
            bright = bright - ((bright * weight).sum((-2, -1)) / total)[:, None, None]
            frames = torch.from_numpy(chain.site.frames)
            shaded, of, dark, cell = _cells(deep[:, rows, columns] & (not free))
            out.append(
                Patch(
                    (number * pieces + i) * pieces + j,
                    number,
                    images,
                    rows,
                    columns,
                    weight,
                    s,
                    slopes,
                    bright,
                    frames[images],
                    shaded,
                    frames[of],
                    dark / scale[shaded, rows, columns],
                    cell,
                    detector[images][:, :, rows, columns].nanmean((-2, -1)),
                    free,
                )
            )
    return out


def _without_lit(deep: Tensor, image: Tensor) -> Tensor:
    """Deep shadow (N, H, W) bool without pixels that stand out in their cell: facets that the DEM has not catch some sunlight there, and none less than none.

    What noise does to an image (N, H, W) is seen below the medians of its cells, where no light is.
    """
    height, width = deep.shape[-2:]
    wide = torch.full((len(deep), -(-height // CELL) * CELL, -(-width // CELL) * CELL), torch.nan)
    wide[:, :height, :width] = torch.where(deep, image.float(), torch.nan)
    cells = wide.unflatten(1, (-1, CELL)).unflatten(3, (-1, CELL))  # (N, rows of cells, CELL, columns of cells, CELL)
    away = cells - cells.movedim(2, 3).flatten(3).nanmedian(-1).values[:, :, None, :, None]
    below = torch.where(away < 0, away.square(), torch.nan)
    noise = below.flatten(1).nanmean(1).sqrt().nan_to_num(0.0)
    usual = away.abs() <= USUAL * noise[:, None, None, None, None]
    return usual.flatten(3).flatten(1, 2)[:, :height, :width]


def _cells(deep: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cells in which an image shows enough deep shadow, (N, h, w) bool: images that have any, (d,); the image of each cell, (s,); (d, h, w)
    shares of pixels in the mean of their cell, and in which one they are.
    """
    _, height, width = deep.shape
    across = math.ceil(width / CELL)
    place = (torch.arange(height) // CELL)[:, None] * across + torch.arange(width) // CELL
    count = torch.zeros(len(deep), int(place.max()) + 1).index_add_(1, place.flatten(), deep.flatten(1).float())
    enough = count >= SHADOWED
    of = torch.nonzero(enough)[:, 0]
    number = torch.zeros_like(count, dtype=torch.long)
    number[enough] = torch.arange(len(of))
    images = torch.unique(of)
    share = deep.float() * (enough / count.clamp(min=1))[:, place]
    return images, of, share[images], number[images][:, place]


__all__ = ["Grid", "Patch", "judged", "make_grid", "make_patches"]
