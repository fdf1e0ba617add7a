"""The U-Net of Lunar-G2R: four stages down, four up, one map of coefficients out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from stages.network.cpu.fused_layers import join, norm_act, pool, quarter_weights
from stages.network.crop_sums import convolution
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

    def differences(self, x: Tensor) -> Tensor:
        """The convolution without its bias.

        x : (B, 1, H, W); returns (B, C, H, W)
        """
        # In float32 whatever the rest is in: bfloat16 keeps three digits of a height, too few for a slope.
        with torch.autocast(x.device.type, enabled=False):
            weight = self.weight - self.weight.mean(dim=(2, 3), keepdim=True)
            return convolution(functional.pad(x.float(), (1, 1, 1, 1), mode="replicate"), weight)

    def forward(self, x: Tensor) -> Tensor:
        """x : (B, 1, H, W), scaled heights; returns (B, C, H, W)."""
        assert self.bias is not None
        y = self.differences(x) + self.bias[:, None, None]
        kind = x.device.type
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

    def fused(self, x: Tensor, keys: Tensor, pad: int) -> Tensor:
        """The same in fewer passes on the CPU. x has its edges continued by a pixel already (heights do not).

        x : (B, C, H + 2, W + 2), or (B, 1, H, W) of heights; keys : (B,); returns (B, D, H + 2 pad, W + 2 pad)
        """
        entry, first, _, drop, second, last, _ = self
        assert isinstance(entry, nn.Conv2d) and isinstance(first, BatchNorm) and isinstance(drop, Dropout)
        assert isinstance(second, nn.Conv2d) and isinstance(last, BatchNorm) and entry.bias is not None
        assert second.bias is not None
        y = entry.differences(x) if isinstance(entry, HeightConv) else convolution(x, entry.weight)
        y = norm_act(y, entry.bias, first, 1, drop, keys)
        y = convolution(y, second.weight)
        return norm_act(y, second.bias, last, pad)


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
        return convolution(features, self.head.weight, self.head.bias)

    def features(self, x: Tensor, keys: Tensor | None = None) -> Tensor:
        """The input of the last layer, (B, F, H, W) with F the first of the widths."""
        if keys is None:
            keys = draw_keys(len(x), x.device) if self.training else x.new_empty(0, dtype=torch.int64)
        # The fused form has no gradient in evaluation mode.
        if x.device.type == "cpu" and (self.training or not torch.is_grad_enabled()):
            return self._fused(x, keys)
        return self.plain_features(x, keys)

    def plain_features(self, x: Tensor, keys: Tensor) -> Tensor:
        """The features by plain PyTorch operations: what GPUs run and the fused form is tested against.

        x : (B, 1, H, W), scaled heights; keys : (B,); returns (B, F, H, W)
        """
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

    def _fused(self, x: Tensor, keys: Tensor) -> Tensor:
        """The same to rounding, in fewer passes: see ``fused``."""
        kept = []
        for block in self.down[:-1]:
            assert isinstance(block, Block)
            kept.append(block.fused(x, keys, 0))
            x = pool(kept[-1])
        bottom = self.down[-1]
        assert isinstance(bottom, Block)
        x = bottom.fused(x, keys, 1)
        for rise, block in zip(self.rise, self.up, strict=True):
            assert isinstance(rise, nn.Conv2d) and rise.bias is not None and isinstance(block, Block)
            quarters = convolution(x, quarter_weights(rise.weight), rise.bias.repeat(4))
            x = block.fused(join(quarters, kept.pop()), keys, 0 if block is self.up[-1] else 1)
        return x
