"""Images laid over the ground."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.effects.filters import gradients
from stages.physics.formation.resampling import displace


def aligned(image: Tensor, valid: Tensor, east: Tensor, south: Tensor) -> tuple[Tensor, Tensor]:
    """An image laid over the ground again, given where it looks for its pixels."""
    east, south = (d.expand_as(image) if d.ndim == 3 else d[:, None, None].expand_as(image) for d in (east, south))
    if not float(torch.maximum(east.abs().max(), south.abs().max())) > 1e-6:
        return image, valid
    # a pixel x shows ground x + d(x), so the ground at g is seen at x = g - d(x): one step from d(g) is enough
    at = []
    for d in (east, south):
        slope = gradients(d)
        at.append(d - slope[0] * east - slope[1] * south)
    return displace(image, -at[0], -at[1]), displace(valid.float(), -at[0], -at[1]) > 0.99


__all__ = ["aligned"]
