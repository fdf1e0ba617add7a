"""Single pixels that stand out by more than small shadows and bright facets do: cosmic rays, hot and dead pixels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from stages.diagnose.settings import STANDS_OUT
from stages.diagnose.structure.innovations import Innovation

NEIGHBOURS = (
    11  # px, side of the square that a pixel is compared with, but for its own 3 x 3, over which images are resampled
)
ENOUGH = 60  # of its pixels that are seen
LARGEST = 100.0  # standard deviations of a neighbour: one that stands out itself is no scale


def pixels_that_stand_out(every: Sequence[Innovation]) -> tuple[int, float]:
    """How many there are, and their share of the squares. A place counts once, in the image that differs most."""
    found, out, total = 0, 0.0, 0.0
    bright, dark = STANDS_OUT
    for one in every:
        ratio = _beside_neighbours(one)
        size = torch.maximum(ratio / bright, -ratio / dark).amax(0)
        peak = size == max_pool2d(size[None], 5, 1, 2)[0]
        odd = peak & (size > 1)
        found += int(odd.sum())
        out += float((one.value.square().amax(0) * odd).sum())
        total += float(one.value.square().sum())
    return found, out / max(total, 1e-9)


def _beside_neighbours(one: Innovation) -> Tensor:
    """(n, h, w) value over the rms of what lies about it, or over the median scatter of its image where that is more."""
    seen = one.seen.float()
    squares = one.value.square().clamp(max=LARGEST**2)
    about = _sum(squares, NEIGHBOURS) - _sum(squares, 3)
    count = _sum(seen, NEIGHBOURS) - _sum(seen, 3)
    rms = (about / count.clamp(min=1)).clamp(min=0).sqrt()
    middle = torch.stack(
        [v[s].abs().median() if s.any() else v.new_ones(()) for v, s in zip(one.value, one.seen, strict=True)]
    )
    ratio = one.value / torch.maximum(rms, 1.4826 * middle[:, None, None]).clamp(min=1e-9)
    return torch.where(one.seen & (count >= ENOUGH), ratio, 0.0)


def _sum(x: Tensor, side: int) -> Tensor:
    return avg_pool2d(x[:, None], side, 1, side // 2)[:, 0] * side**2


__all__ = ["pixels_that_stand_out"]
