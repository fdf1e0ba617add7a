"""The state of an unfinished training run: written after every epoch, and read to go on to the very same result."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import torch
from torch import Tensor

from schemas.errors import ArtefactError
from schemas.files.hdf5 import silence_hdf5, whole_hdf5
from stages.network.predictor import read_state, write_state
from stages.train.training import Training

Weights = dict[str, dict[str, Tensor]]  # by module, as Training.modules names them, and by name


@dataclass
class History:
    """One entry per finished epoch. objective : what is minimised, on validation ground; its least is the best epoch"""

    train_loss: list[float] = field(default_factory=list)
    validation_loss: list[float] = field(default_factory=list)
    objective: list[float] = field(default_factory=list)
    epoch_seconds: list[float] = field(default_factory=list)
    best_epoch: int = -1


def copy_weights(training: Training) -> Weights:
    """A copy of all weights."""
    return {
        part: {name: value.detach().clone() for name, value in module.state_dict().items()}
        for part, module in training.modules.items()
    }


def load_weights(training: Training, weights: Weights) -> None:
    """Go back to weights that :func:`copy_weights` gave."""
    for part, module in training.modules.items():
        module.load_state_dict(weights[part])


def save(sidecar: Path, identity: str, training: Training, history: History, best: Weights) -> None:
    """Write the state of an unfinished run, whole or not at all. best : weights of the best epoch so far"""
    with whole_hdf5(sidecar) as file:
        file.attrs["identity"] = identity
        file.attrs["history"] = json.dumps(asdict(history))
        file.attrs["precision"] = training.precision
        for part, module in training.modules.items():
            write_state(file.create_group(part), module.state_dict())
        for part, weights in best.items():
            write_state(file.create_group(f"best/{part}"), weights)
        for index, moments in training.optimizer.state_dict()["state"].items():
            write_state(file.create_group(f"optimizer/{index}"), {k: torch.as_tensor(v) for k, v in moments.items()})


def restore(sidecar: Path, identity: str, training: Training) -> tuple[History, Weights]:
    """Bring ``training`` to the state of an interrupted run; returns its history and the weights of its best epoch.

    Raises ArtefactError where the state is damaged or another run's.
    """
    silence_hdf5()
    try:
        with h5py.File(sidecar, "r") as file:
            if file.attrs["identity"] != identity:
                raise ArtefactError(
                    f"{sidecar}: the interrupted run had other options or other pairs; repeat its options or remove the file."
                )
            for part, module in training.modules.items():
                module.load_state_dict(read_state(file[part]))
            best = {
                part: {name: value.to(training.device) for name, value in read_state(file[f"best/{part}"]).items()}
                for part in training.modules
            }
            state: dict[str, Any] = training.optimizer.state_dict()
            state["state"] = {
                int(k): {name: _laid_out(value, training.learned[int(k)]) for name, value in read_state(group).items()}
                for k, group in file["optimizer"].items()
            }
            training.optimizer.load_state_dict(state)
            training.precision = str(file.attrs["precision"])
            return History(**json.loads(str(file.attrs["history"]))), best
    except (OSError, KeyError, RuntimeError) as error:
        raise ArtefactError(
            f"{sidecar}: cannot be resumed from ({_first_misfit(error)}); remove it and train again."
        ) from None


def _laid_out(value: Tensor, like: Tensor) -> Tensor:
    """In the memory order of its parameter, which a fused optimiser takes for granted."""
    return torch.empty_like(like).copy_(value) if value.shape == like.shape else value


def _first_misfit(error: BaseException) -> str:
    """PyTorch's line on the first weight that does not fit: its own first line only names a class."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    text = lines[1] if len(lines) > 1 else lines[0]
    text = text.replace(" in state_dict", "")
    return text if len(text) <= 160 else f"{text[:157]}..."
