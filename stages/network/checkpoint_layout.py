"""Checks of the names and shapes in a checkpoint against its network, before memory of their size is allocated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import torch

from schemas.errors import ArtefactError
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.unet import UNet

WIDEST, DEEPEST = 65536, 12  # most channels of a stage, and most stages


def are_widths(widths: Sequence[Any]) -> bool:
    """Whether a network can have these channels by stage."""
    return 2 <= len(widths) <= DEEPEST and all(type(w) is int and 1 <= w <= WIDEST for w in widths)


def are_dropouts(shares: Sequence[Any]) -> bool:
    """Whether a network can drop these shares by stage."""
    return len(shares) > 0 and all(type(p) in (int, float) and 0 <= p < 1 for p in shares)


def read_layout(path: Path, config: dict[str, Any], model: str) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """(widths, dropout) of the network, from the options in a checkpoint. Raises ArtefactError."""
    widths, dropout, name = config.get("widths"), config.get("dropout"), config.get("model", model)
    where = f"{path}: root attribute 'config'"
    if not isinstance(name, str) or name.lower() != model.lower():
        raise ArtefactError(f"{where}: expected the model '{model}' of the file, found '{name}'; train again.")
    if not (isinstance(widths, list) and are_widths(widths)):
        raise ArtefactError(
            f"{where}: expected 'widths' of 2 .. {DEEPEST} stages, each of 1 .. {WIDEST} channels, found {str(widths)[:80]}; train again."
        )
    if not (isinstance(dropout, list) and are_dropouts(dropout)):
        raise ArtefactError(f"{where}: expected 'dropout' of shares 0 .. 1, found {str(dropout)[:80]}; train again.")
    return tuple(widths), tuple(dropout)


def check_weights(
    path: Path, group: Any, maps: CoefficientMaps, widths: tuple[int, ...], dropout: tuple[float, ...]
) -> None:
    """Refuse stored arrays whose names, shapes or kinds are not the network's. Raises ArtefactError."""
    with torch.device("meta"):
        net = UNet(maps.channels, widths, dropout)
    states = {"net": net.state_dict(), "maps": maps.state_dict()}
    expected = {f"{part}.{name}": tuple(value.shape) for part, state in states.items() for name, value in state.items()}
    if not isinstance(group, h5py.Group):
        raise ArtefactError(
            f"{path}:/weights: expected the network's weights, found none; write it again with 'lunargr train'."
        )
    for name, shape in expected.items():
        data = group.get(name)
        if not isinstance(data, h5py.Dataset) or data.shape != shape or data.dtype.kind not in "iuf":
            found = f"{data.dtype} {data.shape}" if isinstance(data, h5py.Dataset) else "none"
            raise ArtefactError(
                f"{path}:/weights/{name}: expected numbers of shape {shape} (widths {'-'.join(map(str, widths))}), found {found}; "
                "train again."
            )
    unknown = sorted(set(group) - set(expected))
    if unknown:
        raise ArtefactError(f"{path}:/weights/{unknown[0]}: the network has no such array; train again.")


def check_finite(path: Path, state: dict[str, torch.Tensor]) -> None:
    """Raises ArtefactError for weights that are not finite: every map made with them would be empty.

    state : by name, tensors of any shape
    """
    for name, value in state.items():
        if not math.isfinite(float(value.double().sum())):
            raise ArtefactError(
                f"{path}:/weights/{name}: expected finite weights, found NaN or infinity; train again, with a lower `lr`."
            )
