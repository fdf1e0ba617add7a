"""The U-Net of Lunar-G2R: four stages down, four up, one map of coefficients out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTHS = (16, 32, 64, 128, 256)
DROPOUT = (0.1, 0.1, 0.2, 0.2, 0.3)
SLOPE = 0.01  # of LeakyReLU below zero


class HeightConv(nn.Conv2d):
    """A convolution whose kernels sum to zero: it sees height differences and never the height itself.

    Lunar-G2R subtracts each crop's mean instead: the same ground then has another input in every window, and the map
    shows squares at their borders. With this layer the mean of a window does not matter, but for rounding.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 3)
        with torch.no_grad():  # neighbours differ far less than heights do: start where BatchNorm's eps is small
            self.weight *= 16

    def forward(self, x: Tensor) -> Tensor:
        """x : (B, 1, H, W), scaled heights; returns (B, C, H, W)."""
        kind = x.device.type
        # In float32 whatever the rest is in: bfloat16 keeps three digits of a height, too few for a slope.
        with torch.autocast(kind, enabled=False):
            weight = self.weight - self.weight.mean(dim=(2, 3), keepdim=True)
            y = functional.conv2d(functional.pad(x.float(), (1, 1, 1, 1), mode="replicate"), weight, self.bias)
        return y.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else y


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    """3x3; edges are continued, not zero: an edge then looks like more terrain, as it is where windows overlap."""
    return nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="replicate")


class Block(nn.Sequential):
    """Two 3x3 convolutions with BatchNorm and LeakyReLU, dropout between them. entry : the first convolution"""

    def __init__(self, entry: nn.Conv2d, outputs: int, dropout: float) -> None:
        super().__init__(
            entry,
            nn.BatchNorm2d(outputs),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Dropout(dropout),
            _conv(outputs, outputs),
            nn.BatchNorm2d(outputs),
            nn.LeakyReLU(SLOPE, inplace=True),
        )


class UNet(nn.Module):
    """elevation (B, 1, H, W), scaled -> raw coefficients (B, C, H, W); H and W are multiples of ``stride``.

    ``widths`` gives the channels of each stage; Lunar-G2R's 16-32-64-128-256 has 2.16 million parameters.
    """

    def __init__(self, outputs: int, widths: Sequence[int] = WIDTHS, dropout: Sequence[float] = DROPOUT) -> None:
        super().__init__()
        if len(dropout) != len(widths):
            dropout = [dropout[min(k, len(dropout) - 1)] for k in range(len(widths))]
        levels = range(len(widths) - 1)
        self.down = nn.ModuleList(
            Block(_conv(widths[k - 1], width) if k else HeightConv(1, width), width, dropout[k])
            for k, width in enumerate(widths)
        )
        self.rise = nn.ModuleList(_conv(widths[k + 1], widths[k]) for k in reversed(levels))
        self.up = nn.ModuleList(Block(_conv(2 * widths[k], widths[k]), widths[k], dropout[k]) for k in reversed(levels))
        self.head = nn.Conv2d(widths[0], outputs, 1)
        nn.init.zeros_(self.head.weight)  # training starts from the uniform surface, not from noise around it
        self.head.bias = nn.Parameter(torch.zeros(outputs))

    @property
    def stride(self) -> int:
        """Pixels by which an input may shift for the output to shift along exactly."""
        return 2 ** (len(self.down) - 1)

    @property
    def reach(self) -> int:
        """Pixels beyond which no input touches an output: the halo that makes windows exact.

        Two 3x3 convolutions at every level down and up, one after each upsampling; a pooled cell adds its own width.
        """
        levels = len(self.down) - 1
        down = sum(2 * 2**k for k in range(levels + 1))
        up = sum(2 * 2**k + 2**k for k in range(levels))
        return down + up + self.stride

    def forward(self, x: Tensor) -> Tensor:
        """x : (B, 1, H, W), scaled heights; returns (B, C, H, W)."""
        return self.head(self.features(x))

    def features(self, x: Tensor) -> Tensor:
        """The input of ``head``, the last layer: (B, F, H, W) with F the first of the widths. x : (B, 1, H, W)"""
        kept = []
        for block in self.down[:-1]:
            x = block(x)
            kept.append(x)
            x = functional.max_pool2d(x, 2)
        x = self.down[-1](x)
        for rise, block in zip(self.rise, self.up, strict=True):
            x = rise(functional.interpolate(x, scale_factor=2.0, mode="nearest"))
            x = block(torch.cat([x, kept.pop()], dim=1))
        return x
