"""The network's steps between convolutions as single operations on the CPU, differentiable: see ``training_kernels``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor

from stages.common.threads import share_out
from stages.network.cpu import training_kernels as kernels
from stages.network.cpu.training_kernels import channels_last, empty, pixels_of, rows_of
from stages.network.layers import BatchNorm, Dropout, dropout_threshold, is_distributed, layer_keys

_NO_KEYS = np.zeros((1, 2), np.uint32)


def _row(values: Tensor | NDArray, columns: int) -> NDArray[np.float32]:
    """One number per channel -> one per value of a row."""
    return np.tile(np.asarray(values, np.float32), columns)


def _stored_as(x: Tensor) -> torch.dtype:
    return torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else x.dtype


def norm_act(
    x: Tensor, bias: Tensor, norm: BatchNorm, pad: int, drop: Dropout | None = None, keys: Tensor | None = None
) -> Tensor:
    """dropout(LeakyReLU(norm(x + bias))), edges continued by ``pad`` (0 or 1) pixels.

    Takes over what ``norm`` does in training, running statistics included; in evaluation mode it has no gradient. A bias
    before a normalisation changes nothing but the running mean: it has no gradient either.

    x : (B, C, H, W); bias : (C,); keys : (B,) int64; returns (B, C, H + 2 pad, W + 2 pad)
    """
    pattern, threshold, factor = _NO_KEYS, 0, 1.0
    if norm.training and drop is not None and drop.p > 0:
        assert keys is not None
        threshold, factor = dropout_threshold(drop.p)
        pattern = torch.stack(layer_keys(keys, drop.layer), dim=1).numpy().astype(np.uint32)
    dropping = (np.ascontiguousarray(np.broadcast_to(pattern, (len(x), 2))), np.uint32(threshold), np.float32(factor))
    x = channels_last(x)
    if not norm.training:
        assert norm.running_mean is not None and norm.running_var is not None
        scale = norm.weight.detach() * torch.rsqrt(norm.running_var + norm.eps)
        shift = norm.bias.detach() + (bias.detach() - norm.running_mean) * scale
        return _apply(x, scale, shift, dropping, pad, _stored_as(x))
    y, mean, variance, count = _NormAct.apply(x, norm.weight, norm.bias, norm.eps, dropping, pad, _stored_as(x))
    norm.update_running(mean + bias.detach(), variance, count)
    return y


def _apply(x: Tensor, scale: Tensor, shift: Tensor, dropping: tuple, pad: int, dtype: torch.dtype) -> Tensor:
    crops, channels, height, width = x.shape
    out = empty(crops, channels, height + 2 * pad, width + 2 * pad, dtype)
    rows = (_row(scale.float(), width), _row(shift.float(), width))
    share_out(kernels.normalise, crops * height, rows_of(x), rows_of(out), *rows, *dropping, pad, channels)
    return out


def _over_processes(values: Tensor) -> Tensor:
    if is_distributed():
        dist.all_reduce(values)
    return values


class _NormAct(torch.autograd.Function):
    """Batch statistics are those of all processes; see ``layers._SharedNorm`` for the mathematics."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, eps: float, dropping: tuple, pad: int, dtype: torch.dtype
    ) -> tuple[Tensor, ...]:
        crops, channels, height, width = x.shape
        pivot = x[0, :, 0, 0].double()  # sums about a value near the mean keep their digits
        parts = np.empty((crops, 2, channels))
        share_out(kernels.sum_moments, crops, rows_of(x), _row(pivot, width), parts)
        one, two = torch.from_numpy(parts.sum(axis=0))
        own = float(crops * height * width)
        about_zero = torch.cat([one + own * pivot, two + 2 * pivot * one + own * pivot * pivot, torch.tensor([own])])
        sums = _over_processes(about_zero)
        count = sums[-1]
        mean = sums[:channels] / count
        variance = (sums[channels:-1] / count - mean * mean).clamp(min=0)
        inverse = torch.rsqrt(variance + eps)
        scale = weight.double() * inverse
        shift = bias.double() - mean * scale
        ctx.save_for_backward(x, mean, inverse, scale, shift, count)
        ctx.settings = dropping, pad
        ctx.mark_non_differentiable(mean, variance, count)
        return _apply(x, scale, shift, dropping, pad, dtype), mean, variance, count

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, mean, inverse, scale, shift, count = ctx.saved_tensors
        dropping, pad = ctx.settings
        crops, channels, _, width = x.shape
        dy = rows_of(channels_last(gradients[0]))
        dx = torch.empty_like(x)
        source, target = rows_of(x), rows_of(dx)
        rows = [_row(v, width) for v in (scale, shift, mean, inverse)]
        parts = np.empty((crops, 2, channels))
        share_out(kernels.sum_gradients, crops, source, dy, target, *rows, *dropping, pad, channels, parts)
        own = torch.from_numpy(parts.sum(axis=0))
        first, second = _over_processes(own.clone()) / count
        linear = -scale * second * inverse
        constant = -scale * first - linear * mean
        share_out(kernels.input_gradient, crops, source, target, *(_row(v, width) for v in (scale, constant, linear)))
        return dx, own[1].float(), own[0].float(), None, None, None, None


class _Pool(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        crops, channels, height, width = x.shape
        ctx.save_for_backward(x)
        out = empty(crops, channels, height // 2 + 2, width // 2 + 2, x.dtype)
        share_out(kernels.pool, crops * (height // 2), pixels_of(x), rows_of(out))
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        dx = torch.empty_like(x)
        share_out(kernels.pool_back, len(x), pixels_of(x), rows_of(channels_last(gradients[0])), pixels_of(dx))
        return dx


def pool(x: Tensor) -> Tensor:
    """Largest of 2 x 2, edges continued by a pixel.

    x : (B, C, H, W); returns (B, C, H / 2 + 2, W / 2 + 2)
    """
    return _Pool.apply(x)


class _Join(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quarters: Tensor, kept: Tensor) -> Tensor:
        crops, others, height, width = kept.shape
        channels = quarters.shape[1] // 4
        ctx.shapes = quarters.shape, kept.shape
        out = empty(crops, channels + others, height + 2, width + 2, kept.dtype)
        share_out(kernels.join, crops * height, pixels_of(quarters), pixels_of(kept), pixels_of(out))
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        dy = channels_last(gradients[0])
        dquarters, dkept = (empty(b, c, h, w, dy.dtype) for b, c, h, w in ctx.shapes)
        share_out(kernels.join_back, len(dy), rows_of(dy), pixels_of(dquarters), pixels_of(dkept))
        return dquarters, dkept


def join(quarters: Tensor, kept: Tensor) -> Tensor:
    """Upsampled values (from :func:`quarter_weights`) beside kept ones, edges continued by a pixel.

    quarters : (B, 4 C, H / 2, W / 2); kept : (B, D, H, W); returns (B, C + D, H + 2, W + 2)
    """
    return _Join.apply(channels_last(quarters), channels_last(kept))


def quarter_weights(weight: Tensor) -> Tensor:
    """A 3 x 3 convolution after nearest upsampling by two, as a 2 x 2 convolution before it.

    (O, I, 3, 3) -> (4 O, I, 2, 2): the four outputs of a square of pixels see 2 x 2 values each, since of three
    neighbours two are copies of one value; with 16 instead of 36 products.
    """
    taps = weight.new_tensor([[[1, 0, 0], [0, 1, 1]], [[1, 1, 0], [0, 0, 1]]])  # (even or odd, 2, 3)
    with torch.autocast(weight.device.type, enabled=False):
        return torch.einsum("apu,bqv,oiuv->aboipq", taps, taps, weight).flatten(0, 2).contiguous()
