"""Batch normalisation and dropout whose results do not depend on how a batch is split over processes."""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

SLOPE = 0.01  # of LeakyReLU below zero
_WORD = 0xFFFFFFFF


def is_distributed() -> bool:
    """Whether several processes share every batch."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


class BatchNorm(nn.BatchNorm2d):
    """Batch normalisation over the crops of all processes, whatever share of them each one holds.

    In evaluation mode, and alone, it is ``nn.BatchNorm2d``, whose parameters and buffers it has; torch's own synchronised
    version needs CUDA.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) normalised by the statistics of the batch over all processes."""
        if not (self.training and is_distributed()):
            return super().forward(x)
        y, mean, variance, count = _SharedNorm.apply(x, self.weight, self.bias, self.eps)
        self.update_running(mean, variance, count)
        return y

    @torch.no_grad()
    def update_running(self, mean: Tensor, variance: Tensor, count: Tensor) -> None:
        """Update the running statistics with those of a batch (float64).

        mean, variance : (C,); count : (), values per channel
        """
        assert self.running_mean is not None and self.running_var is not None and self.momentum is not None
        assert self.num_batches_tracked is not None
        self.num_batches_tracked += 1
        unbiased = variance * (count / (count - 1).clamp(min=1))
        self.running_mean.lerp_(mean.to(self.running_mean.dtype), self.momentum)
        self.running_var.lerp_(unbiased.to(self.running_var.dtype), self.momentum)


class _SharedNorm(torch.autograd.Function):
    """(x - mean) / std * weight + bias, mean and std over batch, rows, columns and processes.

    Sums are exchanged in float64, with the number of pixels, so that shares of any size add up. With the loss summed over
    processes, dL/dx needs the sums of dL/dy and of dL/dy * normalised over all of them as well (Ioffe & Szegedy 2015);
    the gradients of weight and bias stay this process's share, which is added up with all other gradients.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, ...]:
        channels, values = x.shape[1], x.float()
        sums = torch.zeros(2 * channels + 1, dtype=torch.float64, device=x.device)
        sums[:channels] = values.sum((0, 2, 3), dtype=torch.float64)
        sums[channels:-1] = values.double().square().sum((0, 2, 3))
        sums[-1] = x.numel() // channels
        dist.all_reduce(sums)
        count = sums[-1]
        mean = sums[:channels] / count
        variance = (sums[channels:-1] / count - mean * mean).clamp(min=0)
        inverse = torch.rsqrt(variance + eps).float()
        normalised = (values - mean.float()[:, None, None]) * inverse[:, None, None]
        ctx.save_for_backward(x, weight, mean.float(), inverse, count)
        ctx.mark_non_differentiable(mean, variance, count)
        y = normalised * weight[:, None, None] + bias[:, None, None]
        return y.to(x.dtype), mean, variance, count

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, mean, inverse, count = ctx.saved_tensors
        dy = gradients[0].float()
        normalised = (x.float() - mean[:, None, None]) * inverse[:, None, None]
        dbias = dy.sum((0, 2, 3))
        dweight = (dy * normalised).sum((0, 2, 3))
        sums = torch.stack([dbias, dweight]).double()
        dist.all_reduce(sums)
        first, second = (sums / count).float()
        dx = (dy - first[:, None, None] - normalised * second[:, None, None]) * (weight * inverse)[:, None, None]
        return dx.to(x.dtype), dweight, dbias, None


class Dropout(nn.Module):
    """Dropout whose pattern depends on a key of each crop and on the layer, and on nothing else.

    A crop loses the same values whichever process works on it, and beside whichever other crops.
    """

    def __init__(self, p: float, layer: int) -> None:
        super().__init__()
        self.p, self.layer = p, layer

    def forward(self, x: Tensor, keys: Tensor) -> Tensor:
        """x : (B, C, H, W); keys : (B,) int64."""
        if not self.training or self.p == 0:
            return x
        kept, scale = kept_values(keys, self.layer, self.p, x.shape[1:])
        return x * (kept * scale).to(x.dtype)


def draw_keys(count: int, device: torch.device) -> Tensor:
    """Keys for crops that have none, from torch's generator."""
    return torch.randint(0, 2**62, (count,), device=device)


def dropout_threshold(p: float) -> tuple[int, float]:
    """(16-bit numbers below it are dropped, what the rest is multiplied by): exact for the share really dropped."""
    threshold = min(65535, round(p * 65536))
    return threshold, 65536 / (65536 - threshold)


def layer_keys(keys: Tensor, layer: int) -> tuple[Tensor, Tensor]:
    """Two 32-bit numbers per crop for one layer: the finaliser of splitmix64 (Steele et al. 2014) on its key.

    keys : (B,) int64; returns (B,) each
    """
    step = (layer + 1) * 0x9E3779B97F4A7C15 % 2**64
    z = keys + (step - 2**64 if step >= 2**63 else step)
    z = (z ^ (z >> 30 & 0x3FFFFFFFF)) * -4658895280553007687
    z = (z ^ (z >> 27 & 0x1FFFFFFFFF)) * -7723592293110705685
    z = z ^ (z >> 31 & 0x1FFFFFFFF)
    return z & _WORD, z >> 32 & _WORD


def kept_values(keys: Tensor, layer: int, p: float, shape: torch.Size | tuple[int, ...]) -> tuple[Tensor, float]:
    """Mask (B, C, H, W), True = kept, and the factor that keeps the mean.

    A row's values, channels fastest, take 16 bits each of 32-bit words that follow each other through the crop: the first
    half of the row the lower bits, the second half the upper ones.
    """
    channels, height, width = shape
    threshold, scale = dropout_threshold(p)
    low, high = (k[:, None] for k in layer_keys(keys, layer))
    length = width * channels
    half = (length + 1) // 2
    x = torch.arange(height * half, device=keys.device)[None] * 0x9E3779B9 + low & _WORD
    x = (x ^ x >> 16) * 0x21F0AAAD & _WORD
    x = (x ^ x >> 15 ^ high) * 0x735A2D97 & _WORD
    x = (x ^ x >> 15).view(-1, height, half)
    bits = torch.cat([x & 0xFFFF, x[..., : length - half] >> 16], dim=-1)
    return (bits >= threshold).view(-1, height, width, channels).permute(0, 3, 1, 2), scale
