"""The state of an unfinished training run: written after every epoch, read to go on to the very same result."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import torch
from torch import Tensor

from schemas.errors import ArtefactError
from schemas.files.hdf5 import silence_hdf5
from schemas.files.outputs import atomic_path
from stages.network.losses import Radiometry
from stages.network.predictor import Predictor, first_misfit, read_state, write_state


@dataclass
class History:
    """One entry per finished epoch. objective : what is minimised, on validation ground; the least of it is kept"""

    train_loss: list[float] = field(default_factory=list)
    validation_loss: list[float] = field(default_factory=list)
    objective: list[float] = field(default_factory=list)
    epoch_seconds: list[float] = field(default_factory=list)
    best_epoch: int = -1


def snapshot(predictor: Predictor, radiometry: Radiometry) -> dict[str, Tensor]:
    """A copy of all weights, by name."""
    state = {f"predictor/{k}": v.detach().clone() for k, v in predictor.state_dict().items()}
    return state | {f"radiometry/{k}": v.detach().clone() for k, v in radiometry.state_dict().items()}


def save(
    sidecar: Path,
    identity: str,
    predictor: Predictor,
    radiometry: Radiometry,
    optimizer: torch.optim.Optimizer,
    history: History,
    best: dict[str, Tensor],
    precision: str,
) -> None:
    """Write the state of an unfinished run, whole or not at all; best : weights of the best epoch, tensors of any shape."""
    state = optimizer.state_dict()
    with atomic_path(sidecar) as partial, h5py.File(partial, "w", track_order=True) as file:
        file.attrs["identity"] = identity
        file.attrs["history"] = json.dumps(asdict(history))
        file.attrs["precision"] = precision
        write_state(file.create_group("predictor"), predictor.state_dict())
        write_state(file.create_group("radiometry"), radiometry.state_dict())
        for part in ("predictor", "radiometry"):
            write_state(
                file.create_group(f"best/{part}"),
                {k.split("/", 1)[1]: v for k, v in best.items() if k.startswith(part)},
            )
        for index, moments in state["state"].items():
            write_state(file.create_group(f"optimizer/{index}"), {k: torch.as_tensor(v) for k, v in moments.items()})


def _laid_out(value: Tensor, like: Tensor) -> Tensor:
    """In the memory order of its parameter, which a fused optimiser takes for granted."""
    return torch.empty_like(like).copy_(value) if value.shape == like.shape else value


def restore(
    sidecar: Path,
    identity: str,
    predictor: Predictor,
    radiometry: Radiometry,
    optimizer: torch.optim.Optimizer,
    history: History,
    best: dict[str, Tensor],
    device: torch.device,
) -> str:
    """Load the state of an interrupted run; returns its precision. Raises ArtefactError where it was another run's.

    best : the weights of the best epoch so far, tensors of any shape, changed in place
    """
    silence_hdf5()
    try:
        with h5py.File(sidecar, "r") as file:
            if file.attrs["identity"] != identity:
                raise ArtefactError(
                    f"{sidecar}: the interrupted run had other options or other pairs; repeat its options or remove the file."
                )
            predictor.load_state_dict(read_state(file["predictor"]))
            radiometry.load_state_dict(read_state(file["radiometry"]))
            for part in ("predictor", "radiometry"):
                best.update({f"{part}/{k}": v.to(device) for k, v in read_state(file[f"best/{part}"]).items()})
            state: dict[str, Any] = optimizer.state_dict()
            parameters = [p for group in optimizer.param_groups for p in group["params"]]
            state["state"] = {
                int(k): {name: _laid_out(value, parameters[int(k)]) for name, value in read_state(group).items()}
                for k, group in file["optimizer"].items()
            }
            optimizer.load_state_dict(state)
            for key, value in json.loads(str(file.attrs["history"])).items():
                setattr(history, key, value)
            return str(file.attrs["precision"])
    except (OSError, KeyError, RuntimeError) as error:
        raise ArtefactError(
            f"{sidecar}: cannot be resumed from ({first_misfit(error)}); remove it and train again."
        ) from None
