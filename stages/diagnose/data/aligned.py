"""Images laid over the ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, map_coordinates
from torch import Tensor

from stages.effects.filters import gradients
from stages.physics.formation.resampling import displace


def spline(image: Tensor, east: Tensor, south: Tensor) -> Tensor:
    """The image sampled ``east`` columns and ``south`` rows further on, by the quintic B-spline; all (n, H, W).

    What it does to noise hardly depends on the fraction of a pixel. A cubic of four pixels halves it at a third of a cycle per pixel where it
    moves by half a pixel: images that were moved would look less noisy, and their spectra would have edges.
    """
    rows, columns = np.indices(image.shape[-2:])
    moved = [
        map_coordinates(one, [rows + down, columns + right], order=5, mode="nearest")
        for one, right, down in zip(image.numpy(), east.numpy(), south.numpy(), strict=True)
    ]
    return torch.from_numpy(np.stack(moved))


def aligned(
    image: Tensor,
    valid: Tensor,
    east: Tensor,
    south: Tensor,
    sample: Callable[[Tensor, Tensor, Tensor], Tensor] = spline,
) -> tuple[Tensor, Tensor]:
    """An image laid over the ground again, given where it looks for its pixels."""
    east, south = (d.expand_as(image) if d.ndim == 3 else d[:, None, None].expand_as(image) for d in (east, south))
    if not float(torch.maximum(east.abs().max(), south.abs().max())) > 1e-6:
        return image, valid
    # a pixel x shows ground x + d(x), so the ground at g is seen at x = g - d(x): one step from d(g) is enough
    at = []
    for d in (east, south):
        slope = gradients(d)
        at.append(d - slope[0] * east - slope[1] * south)
    known = displace(valid.float(), -at[0], -at[1]) > 0.99
    return sample(_without_holes(image, valid), -at[0], -at[1]), known


def _without_holes(image: Tensor, valid: Tensor) -> Tensor:
    """The image with its nearest valid pixel where it has none: a spline rings about steps."""
    if bool(valid.all()):
        return image
    out = image.clone()
    for k in torch.nonzero(~valid.all(-1).all(-1) & valid.any(-1).any(-1)).flatten().tolist():
        near = distance_transform_edt(~valid[k].numpy(), return_distances=False, return_indices=True)
        out[k] = image[k][tuple(torch.from_numpy(near).long())]
    return out


__all__ = ["aligned"]
