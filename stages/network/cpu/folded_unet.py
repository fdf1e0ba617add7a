"""A trained network with every BatchNorm folded into the convolution before it, each a single operation with its LeakyReLU."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from stages.network.cpu import inference_kernels as row_kernels
from stages.network.cpu.fused_layers import quarter_weights
from stages.network.cpu.training_kernels import SLOPE, channels_last, empty, pixels_of
from stages.network.layers import BatchNorm
from stages.network.unet import Block, HeightConv, UNet

TYPICAL = (64, 1024)  # rows and columns at full resolution for which weights are laid out; others work as well


def _fold(conv: nn.Conv2d, norm: BatchNorm, weight: Tensor) -> tuple[Tensor, Tensor]:
    assert conv.bias is not None and norm.running_mean is not None and norm.running_var is not None
    scale = norm.weight.double() * torch.rsqrt(norm.running_var.double() + norm.eps)
    shift = norm.bias.double() + (conv.bias.double() - norm.running_mean.double()) * scale
    return (weight.double() * scale[:, None, None, None]).float(), shift.float()


class Conv:
    """A convolution of one row of kernels above and, for 3 x 3, one below, which the input holds already.

    Columns are continued only where the input ends at the map's own edges; elsewhere the outermost columns come out wrong.
    """

    def __init__(self, weight: Tensor, bias: Tensor, active: bool, dtype: torch.dtype, level: int) -> None:
        self.bias, self.active, self.size = bias.float(), active, weight.shape[-1]
        self.outputs, self.inputs = weight.shape[:2]
        self.pad = 1 if self.size > 1 else 0
        self.weight = weight.to(dtype).contiguous(memory_format=torch.channels_last)
        self.packed = None
        # PyTorch's own operator for its compiler: bias and activation cost no pass over memory of their own.
        if torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise"):
            size = [1, weight.shape[1], max(8, TYPICAL[0] >> level), max(8, TYPICAL[1] >> level)]
            ones = [1, 1]
            self.packed = torch.ops.mkldnn._reorder_convolution_weight(self.weight, [0, self.pad], ones, ones, 1, size)

    def _run(self, x: Tensor, pad: int) -> Tensor:
        if self.packed is None:
            y = functional.conv2d(x, self.weight, self.bias.to(x.dtype), padding=(0, pad))
            return functional.leaky_relu_(y, float(SLOPE)) if self.active else y
        how = ("leaky_relu", [float(SLOPE)], "") if self.active else ("none", [], "")
        ones = [1, 1]
        return torch.ops.mkldnn._convolution_pointwise(x, self.packed, self.bias, [0, pad], ones, ones, 1, *how)

    def __call__(self, x: Tensor, left: bool = False, right: bool = False) -> Tensor:
        """(1, I, n + size - 1, W) -> (1, O, n, W), or W + 1 for 2 x 2. ``left``, ``right``: the map ends there."""
        y = self._run(x, self.pad)
        near = self.size - 1
        if left and near:
            y[..., :1] = self._run(channels_last(torch.cat([x[..., :1], x[..., :near]], -1)), 0)
        if right and near:
            y[..., -1:] = self._run(channels_last(torch.cat([x[..., x.shape[-1] - near :], x[..., -1:]], -1)), 0)
        return y


class FirstConv:
    """The network's first layer: see :func:`inference_kernels.heights`. ``scale`` : m, by which heights are divided."""

    def __init__(self, conv: HeightConv, norm: BatchNorm, scale: float, dtype: torch.dtype) -> None:
        centred = conv.weight - conv.weight.mean(dim=(2, 3), keepdim=True)
        weight, bias = _fold(conv, norm, centred / scale)
        around = weight.flatten(1)[:, [0, 1, 2, 3, 5, 6, 7, 8]].T
        self.weights, self.dtype = row_kernels.lanes(torch.cat([bias[None], around]).numpy()), dtype
        self.channels = len(bias)

    def __call__(self, terrain: Tensor) -> Tensor:
        """(n + 2, W) m -> (1, C, n, W)"""
        rows, columns = terrain.shape
        out = empty(1, self.channels, rows - 2, columns, self.dtype)
        row_kernels.heights(terrain.numpy(), self.weights, pixels_of(out)[0])
        return out


class FoldedUNet:
    """The convolutions of a :class:`UNet` in evaluation mode: ``down`` and ``up`` are pairs, ``up[k]`` and ``rise[k]`` at level k.

    ``first`` replaces the first convolution of ``down[0]``. elevation_scale : m
    """

    @torch.no_grad()
    def __init__(self, net: UNet, elevation_scale: float, dtype: torch.dtype) -> None:
        self.dtype, self.levels, self.stride, self.reach = dtype, len(net.down), net.stride, net.reach

        def pair(block: nn.Module, level: int) -> tuple[Conv | None, Conv]:
            assert isinstance(block, Block)
            entry, first, _, _, second, last, _ = block
            assert isinstance(second, nn.Conv2d) and isinstance(last, BatchNorm)
            after = Conv(*_fold(second, last, second.weight), True, dtype, level)
            if isinstance(entry, HeightConv):
                return None, after
            assert isinstance(entry, nn.Conv2d) and isinstance(first, BatchNorm)
            return Conv(*_fold(entry, first, entry.weight), True, dtype, level), after

        def raising(conv: nn.Module, level: int) -> Conv:
            assert isinstance(conv, nn.Conv2d) and conv.bias is not None
            return Conv(quarter_weights(conv.weight), conv.bias.repeat(4), False, dtype, level)

        entry, norm = net.down[0][0], net.down[0][1]  # type: ignore[index]
        assert isinstance(entry, HeightConv) and isinstance(norm, BatchNorm)
        self.first = FirstConv(entry, norm, elevation_scale, dtype)
        self.down = [pair(block, k) for k, block in enumerate(net.down)]
        self.up = [pair(block, k) for k, block in enumerate(reversed(net.up))]
        self.rise = [raising(conv, k + 1) for k, conv in enumerate(reversed(net.rise))]
        assert net.head.bias is not None
        self.head = Conv(net.head.weight, net.head.bias, False, dtype, 0)
