"""From elevations to the network's input: one scale for a whole data set."""

from __future__ import annotations

from torch import Tensor


def scale_elevation(elevation: Tensor, scale: float) -> Tensor:
    """(B, H, W) m -> (B, 1, H, W), centred and scaled. The centre only saves digits: the first layer ignores it."""
    centred = elevation - elevation.mean(dim=(-2, -1), keepdim=True)
    return (centred / scale).unsqueeze(1)
