"""The eight symmetries of the square, for fields on a crop and for the vectors that belong to them."""

from __future__ import annotations

import torch
from torch import Tensor

COUNT = 8


def turn_field(field: Tensor, symmetry: int) -> Tensor:
    """Quarter turns counter-clockwise (``symmetry % 4``) after a mirror east-west (``symmetry >= 4``).

    field : (..., H, W) with H = W for odd quarter turns
    """
    if symmetry >= 4:
        field = field.flip(-1)
    return torch.rot90(field, symmetry % 4, (-2, -1))


def turn_vector(vector: Tensor, symmetry: int) -> Tensor:
    """The same symmetry for (..., 3) vectors in east, north, up: Sun and camera turn along with the ground."""
    east, north, up = vector.unbind(-1)
    if symmetry >= 4:
        east = -east
    for _ in range(symmetry % 4):
        east, north = -north, east
    return torch.stack([east, north, up], dim=-1)
