"""A trained U-Net over a map from north to south, strip by strip: every layer keeps the rows that it still needs.

Each layer takes rows from the one before it as the next one asks for them. No row is computed twice, however far the
network sees, and memory grows with the width of the map, not with its height.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stages.network.unet import SLOPE, UNet

Piece = tuple[Tensor, bool]  # rows (1, C, n, W), n > 0, and whether they are the last
Rows = Iterator[Piece]  # from north to south
Kernel = Callable[[Tensor], Tensor]


class StripUNet:
    """A :class:`UNet` in evaluation mode, with every BatchNorm folded into the convolution before it.

    elevation_scale : m; dtype : in which all layers but the first work
    """

    @torch.no_grad()
    def __init__(self, net: UNet, elevation_scale: float, dtype: torch.dtype) -> None:
        down, up = ([self._folded(block, dtype) for block in blocks] for blocks in (net.down, reversed(net.up)))
        entry = _fuse(net.down[0][0], net.down[0][1])  # type: ignore[index]
        down[0][0] = partial(_convolve_heights, entry.weight / elevation_scale, entry.bias, dtype)
        self.down, self.up = down, up
        self.rise = [self._kernel(conv, dtype) for conv in reversed(net.rise)]
        self.head = self._kernel(net.head, dtype)

    def _folded(self, block: nn.Module, dtype: torch.dtype) -> list[Kernel]:
        first, norm, _, _, second, last, _ = block.children()
        return [self._kernel(_fuse(conv, after), dtype) for conv, after in ((first, norm), (second, last))]

    @staticmethod
    def _kernel(conv: nn.Module, dtype: torch.dtype) -> Kernel:
        assert isinstance(conv, nn.Conv2d) and conv.bias is not None
        weight = conv.weight.detach().to(dtype, memory_format=torch.channels_last)
        return partial(functional.conv2d, weight=weight, bias=conv.bias.detach().to(dtype))

    def run(self, heights: Rows) -> Iterator[Tensor]:
        """Raw coefficients (1, C, n, W) of heights (1, 1, n, W) in m, whose rows and columns are multiples of ``stride``.

        Edges are continued. The pieces that come out have other heights than those that go in.
        """
        return map(lambda piece: self.head(piece[0]), self._level(0, heights))

    def _level(self, level: int, rows: Rows) -> Rows:
        """Everything from a level downwards and back, at the resolution of that level."""
        rows = _two_layers(self.down[level], rows)
        if level == len(self.down) - 1:
            return rows
        skip = _Skip()
        below = self._level(level + 1, _through(_Pool(), map(skip.keep, rows)))
        raised = _through(_Convolve(self.rise[level]), map(_upsample, below))
        return _two_layers(self.up[level], map(skip.join, raised))


def _fuse(conv: nn.Module, norm: nn.Module) -> nn.Conv2d:
    assert isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
    return fuse_conv_bn_eval(conv, norm)


def _convolve_heights(weight: Tensor, bias: Tensor | None, dtype: torch.dtype, x: Tensor) -> Tensor:
    """The network's first layer, (1, 1, n + 2, W + 2) m -> (1, C, n, W): see :class:`unet.HeightConv`. weight : 1/m

    Differences to the middle pixel are taken first: the height itself then leaves no rounding, and the same ground gives
    the same bits in every window.
    """
    height, width = x.shape[2] - 2, x.shape[3] - 2
    around = [x[..., r : r + height, c : c + width] for r in range(3) for c in range(3)]
    middle = around.pop(4)
    taps = (weight - weight.mean(dim=(2, 3), keepdim=True)).flatten(2)
    taps = torch.cat([taps[..., :4], taps[..., 5:]], dim=2).view(len(weight), 8, 1, 1)
    y = functional.conv2d(torch.cat(around, dim=1) - middle, taps, bias)
    return y.to(dtype, memory_format=torch.channels_last)


def _through(layer: Callable[[Piece], Piece | None], rows: Rows) -> Rows:
    """The rows that a layer gives, without empty pieces; a generator would keep tensors alive in its variables."""
    return filter(None, map(layer, rows))


def _two_layers(kernels: Sequence[Kernel], rows: Rows) -> Rows:
    for kernel in kernels:
        rows = map(_activate, _through(_Convolve(kernel), rows))
    return rows


class _Convolve:
    """A 3 x 3 convolution, edges continued: a row comes out when the one below it came in."""

    def __init__(self, kernel: Kernel) -> None:
        self.kernel, self._above = kernel, torch.empty(0)

    def __call__(self, piece: Piece) -> Piece | None:
        x, last = piece
        above = self._above if self._above.numel() else x[:, :, :1]
        joined = _widen([above, x, x[:, :, -1:]] if last else [above, x])
        self._above = joined[:, :, -2:, 1:-1].clone(memory_format=torch.channels_last)
        return (self.kernel(joined), last) if joined.shape[2] > 2 else None


def _widen(parts: list[Tensor]) -> Tensor:
    """Rows (1, C, n, W) one below the other, continued by a column at both sides."""
    x = parts[0]
    shape = (1, x.shape[1], sum(part.shape[2] for part in parts), x.shape[3] + 2)
    out = torch.empty(shape, dtype=x.dtype, device=x.device, memory_format=torch.channels_last)
    first = 0
    for part in parts:
        out[:, :, first : first + part.shape[2], 1:-1] = part
        first += part.shape[2]
    out[..., 0], out[..., -1] = out[..., 1], out[..., -2]
    return out


def _activate(piece: Piece) -> Piece:
    return functional.leaky_relu_(piece[0], SLOPE), piece[1]


class _Pool:
    """Largest of 2 x 2."""

    def __init__(self) -> None:
        self._odd = torch.empty(0)

    def __call__(self, piece: Piece) -> Piece | None:
        x, last = piece
        if self._odd.numel():
            x = torch.cat([self._odd, x], dim=2)
        even = x.shape[2] // 2 * 2
        self._odd = x[:, :, even:].clone(memory_format=torch.channels_last)
        return (functional.max_pool2d(x[:, :, :even], 2), last) if even else None


def _upsample(piece: Piece) -> Piece:
    return functional.interpolate(piece[0], scale_factor=2.0, mode="nearest"), piece[1]


class _Skip:
    """The skip connection of a level: keeps rows of the way down until the upsampled ones reach them."""

    def __init__(self) -> None:
        self._waiting: deque[Tensor] = deque()

    def keep(self, piece: Piece) -> Piece:
        self._waiting.append(piece[0])
        return piece

    def join(self, piece: Piece) -> Piece:
        x, last = piece
        missing, kept = x.shape[2], []
        while missing:
            rows = self._waiting.popleft()
            kept.append(rows[:, :, :missing])
            if rows.shape[2] > missing:
                self._waiting.appendleft(rows[:, :, missing:])
            missing -= kept[-1].shape[2]
        return torch.cat([x, torch.cat(kept, dim=2)], dim=1), last
