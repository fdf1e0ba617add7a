"""The precision, fp32 or bf16, in which a machine trains and predicts fastest."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from schemas.errors import ConfigError
from stages.network.mapper import Mapper
from stages.network.predictor import Predictor

LARGEST_ERROR = 0.02  # of bf16 in inference, over a coefficient's standard deviation


def check_precision(name: str) -> None:
    """Raises ConfigError for anything but auto, fp32 and bf16."""
    if name not in ("auto", "fp32", "bf16"):
        raise ConfigError(f"`precision`: expected auto, fp32 or bf16, found '{name}'.")


def choose_precision(device: torch.device) -> str:
    """'bf16' for training where the processor multiplies matrices in it, else 'fp32'.

    Not by timing: the same machine must always choose the same, however busy it is.
    """
    return "bf16" if _has_bf16(device, "_is_amx_tile_supported") else "fp32"


def choose_inference_precision(predictor: Predictor, sample: NDArray[np.float32], device: torch.device) -> str:
    """'bf16' where the processor has instructions for it and the coefficients of a sample hardly change, else 'fp32'.

    Not by timing: all parts of a map, on machines of one kind, must choose the same. sample : (H, W) m
    """
    if not _has_bf16(device, "_is_amx_tile_supported", "_is_avx512_bf16_supported"):
        return "fp32"
    exact, short = (_coefficients(predictor, device, precision, sample) for precision in ("fp32", "bf16"))
    error = np.sqrt(np.square(short - exact).mean(axis=(1, 2)))
    spread = exact.std(axis=(1, 2))
    return "bf16" if bool((error <= LARGEST_ERROR * spread + 1e-6).all()) else "fp32"


def _has_bf16(device: torch.device, *instructions: str) -> bool:
    """Whether a GPU has bf16, or a CPU one of these kinds of instructions, by the names of PyTorch's questions."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return any(bool(getattr(torch.cpu, name, lambda: False)()) for name in instructions)


def _coefficients(predictor: Predictor, device: torch.device, precision: str, sample: NDArray) -> NDArray[np.float32]:
    """(C, H, W), those of a sample as if it were a whole map."""
    rows, columns = (-(-edge // predictor.net.stride) * predictor.net.stride for edge in sample.shape)
    continued = np.pad(sample, ((0, rows - sample.shape[0]), (0, columns - sample.shape[1])), mode="edge")

    def terrain(first: int, last: int, left: int, right: int) -> NDArray:
        return np.ascontiguousarray(continued[first:last, left:right])

    found = Mapper(predictor, device, precision).strips(terrain, sample.shape, (0, 0, *sample.shape))
    return np.concatenate([values for _, values in found], axis=1)
