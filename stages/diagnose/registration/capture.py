"""Shifts of several pixels, found by correlating images with their rendering under masks."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.effects.filters import fine


def correlation(image: Tensor, valid: Tensor, rendered: Tensor, lit: Tensor, most: int) -> Tensor:
    """Normalised correlation at every whole shift, (n, 2 most + 1, 2 most + 1), rows then columns: image(x) with rendered(x + shift).

    Masked as by Padfield (2012, IEEE Trans. Image Process. 21, 2706); 0 where under a quarter of the pixels overlap.
    """
    height, width = image.shape[-2:]
    size = (height + 2 * most, width + 2 * most)

    def spectrum(x: Tensor) -> Tensor:
        return torch.fft.rfft2(x, s=size)

    a, m1, b, m2 = spectrum(image * valid), spectrum(valid), spectrum(rendered * lit), spectrum(lit)
    a2, b2 = spectrum(image**2 * valid), spectrum(rendered**2 * lit)

    def cross(x: Tensor, y: Tensor) -> Tensor:
        whole = torch.fft.irfft2(x.conj() * y, s=size)
        return torch.roll(whole, (most, most), (-2, -1))[..., : 2 * most + 1, : 2 * most + 1]

    count = cross(m1, m2).clamp(min=1e-3)
    sum_a, sum_b = cross(a, m2), cross(m1, b)
    top = cross(a, b) - sum_a * sum_b / count
    below = (cross(a2, m2) - sum_a**2 / count).clamp(min=0) * (cross(m1, b2) - sum_b**2 / count).clamp(min=0)
    enough = count > 0.25 * torch.minimum(valid.sum((-2, -1)), lit.sum((-2, -1)))[:, None, None]
    return torch.where(enough, top / below.clamp(min=1e-30).sqrt(), 0.0)


def correlations(image: Tensor, valid: Tensor, rendered: Tensor, lit: Tensor, most: int, sigma: float) -> Tensor:
    """:func:`correlation` of what is finer than ``sigma`` px."""
    valid, lit = valid.float(), lit.float()
    return correlation(fine(image, valid, sigma), valid, fine(rendered, lit, sigma), lit, most)


def contrast(image: Tensor, valid: Tensor, rendered: Tensor, lit: Tensor, sigma: float) -> Tensor:
    """(n,) rms of images over that of their renderings, of what is finer than ``sigma`` px."""
    both = (valid & lit).float()
    measured, expected = fine(torch.stack([image, rendered]), both, sigma)
    return (measured.square().sum((-2, -1)) / expected.square().sum((-2, -1)).clamp(min=1e-30)).sqrt()


def peak(map_: Tensor) -> tuple[Tensor, Tensor]:
    """Where maps (n, S, S) of all shifts are highest, (n, 2) px east and south, and the value there, (n,)."""
    best, place = map_.flatten(1).max(1)
    most = map_.shape[-1] // 2
    row, column = place // map_.shape[-1], place % map_.shape[-1]
    n = torch.arange(len(map_))
    inner_row, inner_column = row.clamp(1, 2 * most - 1), column.clamp(1, 2 * most - 1)

    def vertex(low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
        bend = (low - 2 * middle + high).clamp(max=-1e-9)
        return (0.5 * (low - high) / bend).clamp(-0.5, 0.5)

    south = vertex(map_[n, inner_row - 1, column], map_[n, inner_row, column], map_[n, inner_row + 1, column])
    east = vertex(map_[n, row, inner_column - 1], map_[n, row, inner_column], map_[n, row, inner_column + 1])
    return torch.stack([column - most + east, row - most + south], 1), best


__all__ = ["contrast", "correlation", "correlations", "peak"]
