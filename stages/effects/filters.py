"""Gaussian filtering with a signed variance, curvature and gradients of images."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import pad, softplus

SEAM = 8.0  # robust standard deviations: relief has no line that is so straight and so high
SUDDEN = 6.0  # inverse width, in nats of amplitude, of the passage to the largest gain
MARGIN = 12  # px of mirrored border, over 3 sigma of anything that the effects ask for


def gaussian(image: Tensor, sigma2: Tensor | float, limit: float = 4.0, slopes: bool = False) -> Tensor:
    """Blur by a Gaussian of variance ``sigma2`` px^2; negative: sharpen, each frequency at most ``limit`` times.

    image : (..., H, W); sigma2 : scalar. Differentiable in both.
    slopes : go on beyond the borders with the slope that there is (heights), not mirrored (brightness): no crease is sharpened
    """

    def gain(waves: Tensor) -> Tensor:
        power = -0.5 * torch.as_tensor(sigma2, dtype=image.dtype) * waves.square()
        # a sudden end would make waves stop growing one after the other, and what is fitted to them jump
        log_limit = math.log(limit)
        nothing = math.log1p(math.exp(-SUDDEN * log_limit))  # what is over where nothing is filtered
        over = softplus(SUDDEN * (power - log_limit)) - nothing
        return torch.exp(power - over / SUDDEN)

    return filtered(image, gain, slopes)


def filtered(image: Tensor, gain: Callable[[Tensor], Tensor], slopes: bool = False) -> Tensor:
    """Every wave of (..., H, W) times its ``gain``, a function of wave numbers, rad/px; ``slopes``: as of :func:`gaussian`."""
    return directed(image, lambda kx, ky: gain(torch.hypot(kx, ky)), slopes)


def directed(image: Tensor, gain: Callable[[Tensor, Tensor], Tensor], slopes: bool = False) -> Tensor:
    """The same with a ``gain`` that is a function of wave numbers along columns (1, K) and along rows (H, 1)."""
    margin = min(MARGIN, image.shape[-1] - 1, image.shape[-2] - 1)
    if slopes:
        wide = _turned(_turned(image, margin).transpose(-2, -1), margin).transpose(-2, -1)
    else:
        wide = pad(image.flatten(0, -3)[:, None], (margin,) * 4, mode="reflect")[:, 0]
        wide = wide.view(*image.shape[:-2], *wide.shape[-2:])
    height, width = wide.shape[-2:]
    ky = torch.fft.fftfreq(height, device=image.device)[:, None] * (2 * math.pi)
    kx = torch.fft.rfftfreq(width, device=image.device) * (2 * math.pi)
    changed = torch.fft.irfft2(torch.fft.rfft2(wide) * gain(kx, ky), s=(height, width))
    return changed[..., margin : height - margin, margin : width - margin]


def fine(image: Tensor, mask: Tensor, sigma: float) -> Tensor:
    """The image (..., H, W) less its Gaussian mean over ``sigma`` px of valid pixels, 0 where invalid; mask : broadcastable to it."""
    down, across = (blur_matrix(count, sigma).to(image.dtype) for count in image.shape[-2:])
    share = (down @ mask @ across.T).clamp(min=1e-3)
    return (image - down @ (image * mask) @ across.T / share) * mask


@lru_cache(maxsize=8)
def blur_matrix(count: int, sigma: float) -> Tensor:
    """(count, count) by which a Gaussian of ``sigma`` px blurs one axis, mirrored at its borders: two products are faster than a transform."""
    distance = torch.arange(count)[:, None] - torch.arange(-count, 2 * count)
    # smaller numbers would be denormal, and slow
    kernel = torch.exp(-0.5 * (distance / sigma).square().clamp(max=60.0))
    before, here, after = (kernel / kernel.sum(1, keepdim=True)).split(count, 1)
    return here + before.flip(1) + after.flip(1)


def plane(heights: Tensor) -> Tensor:
    """(B, H, W) the plane nearest to heights (B, H, W), by least squares."""
    height, width = heights.shape[-2:]
    y = torch.linspace(-1, 1, height, dtype=heights.dtype)[:, None]
    x = torch.linspace(-1, 1, width, dtype=heights.dtype)

    def along(ramp: Tensor) -> Tensor:
        return (heights * ramp).mean((-2, -1), keepdim=True) / ramp.square().mean() * ramp

    return heights.mean((-2, -1), keepdim=True) + along(x) + along(y)


def seams(heights: Tensor) -> Tensor:
    """What steps along whole rows or columns, which mosaics and tracks leave, add to heights (B, H, W); m, (B, H, W).

    A step is the median, along the line, of how far the heights jump more than beside it; it counts where it is SEAM robust
    standard deviations of all lines.
    """

    def along(z: Tensor) -> Tensor:
        jump = z.diff(dim=-2)
        beside = 0.5 * (jump[:, :-2] + jump[:, 2:])
        step = pad((jump[:, 1:-1] - beside).median(-1).values, (1, 1))
        size = step.abs()
        highest = size >= torch.nn.functional.max_pool1d(size[:, None], 3, 1, 1)[:, 0]
        usual = 1.4826 * size.median(-1, keepdim=True).values
        step = torch.where(highest & (size > SEAM * usual), step, 0.0)
        return pad(step.cumsum(-1), (1, 0))[..., None]

    z = heights.detach()
    return (along(z) + along(z.mT).mT).expand_as(z)


def _turned(image: Tensor, margin: int) -> Tensor:
    """(..., margin + W + margin): columns beyond either border, turned by half a circle about it."""
    left = 2 * image[..., :1] - image[..., 1 : margin + 1].flip(-1)
    right = 2 * image[..., -1:] - image[..., -margin - 1 : -1].flip(-1)
    return torch.cat([left, image, right], -1)


def laplacian(image: Tensor, gsd: float) -> Tensor:
    """Five-point Laplacian, edges repeated; image : (B, H, W)."""
    wide = pad(image[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    centre = wide[:, 1:-1, 1:-1]
    ring = wide[:, :-2, 1:-1] + wide[:, 2:, 1:-1] + wide[:, 1:-1, :-2] + wide[:, 1:-1, 2:]
    return (ring - 4 * centre) / (gsd * gsd)


def gradients(image: Tensor) -> tuple[Tensor, Tensor]:
    """Change per pixel to the east and to the south, by fourth-order differences; image : (..., H, W)."""
    wide = pad(image.flatten(0, -3)[:, None], (2,) * 4, mode="replicate")[:, 0]
    east = (8 * (wide[:, 2:-2, 3:-1] - wide[:, 2:-2, 1:-3]) - (wide[:, 2:-2, 4:] - wide[:, 2:-2, :-4])) / 12
    south = (8 * (wide[:, 3:-1, 2:-2] - wide[:, 1:-3, 2:-2]) - (wide[:, 4:, 2:-2] - wide[:, :-4, 2:-2])) / 12
    return east.view(image.shape), south.view(image.shape)
