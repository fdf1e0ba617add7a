"""The U-Net of Lunar-G2R: four stages down, four up, one map of coefficients out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from stages.network.layers import SLOPE, BatchNorm, Dropout, draw_keys

WIDTHS = (16, 32, 64, 128, 256)
DROPOUT = (0.1, 0.1, 0.2, 0.2, 0.3)


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
    """Two 3x3 convolutions with BatchNorm and LeakyReLU, dropout between them. ``layer`` numbers the dropout."""

    def __init__(self, inputs: int, outputs: int, dropout: float, layer: int) -> None:
        super().__init__(
            HeightConv(inputs, outputs) if layer == 0 else _conv(inputs, outputs),
            BatchNorm(outputs),
            nn.LeakyReLU(SLOPE, inplace=True),
            Dropout(dropout, layer),
            _conv(outputs, outputs),
            BatchNorm(outputs),
            nn.LeakyReLU(SLOPE, inplace=True),
        )

    def forward(self, x: Tensor, keys: Tensor) -> Tensor:  # type: ignore[override]
        """x : (B, C, H, W); keys : (B,); returns (B, D, H, W)."""
        for step in self:
            x = step(x, keys) if isinstance(step, Dropout) else step(x)
        return x


class UNet(nn.Module):
    """elevation (B, 1, H, W), scaled -> raw coefficients (B, C, H, W); H and W are multiples of ``stride``.

    ``widths`` gives the channels of each stage; Lunar-G2R's 16-32-64-128-256 has 2.16 million parameters.
    """

    def __init__(self, outputs: int, widths: Sequence[int] = WIDTHS, dropout: Sequence[float] = DROPOUT) -> None:
        super().__init__()
        if len(dropout) != len(widths):
            dropout = [dropout[min(k, len(dropout) - 1)] for k in range(len(widths))]
        self.down = nn.ModuleList(
            Block(1 if k == 0 else widths[k - 1], width, dropout[k], k) for k, width in enumerate(widths)
        )
        self.rise = nn.ModuleList(_conv(widths[k + 1], widths[k]) for k in reversed(range(len(widths) - 1)))
        self.up = nn.ModuleList(
            Block(2 * widths[k], widths[k], dropout[k], 2 * len(widths) - 2 - k)
            for k in reversed(range(len(widths) - 1))
        )
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

    def forward(self, x: Tensor, keys: Tensor | None = None) -> Tensor:
        """x : (B, 1, H, W), scaled heights; keys : (B,) int64, of each crop's dropout, drawn where None."""
        return self.read_out(self.features(x, keys))

    def read_out(self, features: Tensor) -> Tensor:
        """(B, F, H, W) -> (B, C, H, W), the last layer."""
        return self.head(features)

    def features(self, x: Tensor, keys: Tensor | None = None) -> Tensor:
        """The input of the last layer, (B, F, H, W) with F the first of the widths."""
        if keys is None:
            keys = draw_keys(len(x), x.device) if self.training else x.new_empty(0, dtype=torch.int64)
        kept = []
        for block in self.down[:-1]:
            x = block(x, keys)
            kept.append(x)
            x = functional.max_pool2d(x, 2)
        x = self.down[-1](x, keys)
        for rise, block in zip(self.rise, self.up, strict=True):
            x = rise(functional.interpolate(x, scale_factor=2.0, mode="nearest"))
            x = block(torch.cat([x, kept.pop()], dim=1), keys)
        return x
