"""Which precision a machine runs fastest in: bf16 only where a probe finds it faster."""

from __future__ import annotations

import time

import numpy as np
import torch
from numpy.typing import NDArray

from stages.network.cpu.mapper import Mapper
from stages.network.predictor import Predictor

CLOSE = 0.02  # of a coefficient's spread: what bf16 may cost in inference
WORTH_IT = 1.25  # bf16 loses digits: it must be faster by this much


def choose_precision(predictor: Predictor, size: tuple[int, int], device: torch.device) -> str:
    """'bf16' where two training steps with it are clearly faster on this device, else 'fp32'; leaves no trace."""
    seconds = {name: _time_step(predictor, size, device, name == "bf16") for name in ("fp32", "bf16")}
    return "bf16" if seconds["fp32"] > WORTH_IT * seconds["bf16"] else "fp32"


def choose_inference_precision(predictor: Predictor, sample: NDArray[np.float32], device: torch.device) -> str:
    """'bf16' where the processor has instructions for it and the coefficients of a sample keep their meaning.

    Nothing is timed: all parts of a map, on machines of one kind, must choose alike. sample : (H, W) m
    """
    if device.type == "cpu":
        able = any(
            bool(getattr(torch.cpu, name, lambda: False)())
            for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported")
        )
    else:
        able = torch.cuda.is_bf16_supported()
    if not able:
        return "fp32"
    exact, short = (_coefficients(predictor, device, precision, sample) for precision in ("fp32", "bf16"))
    error = np.sqrt(np.square(short - exact).mean(axis=(1, 2)))
    spread = exact.std(axis=(1, 2))
    return "bf16" if bool((error <= CLOSE * spread + 1e-6).all()) else "fp32"


def _coefficients(predictor: Predictor, device: torch.device, precision: str, sample: NDArray) -> NDArray[np.float32]:
    """(C, H, W) of a sample that is taken for a whole map."""
    rows, columns = (-(-edge // predictor.net.stride) * predictor.net.stride for edge in sample.shape)
    continued = np.pad(sample, ((2, rows + 2 - sample.shape[0]), (0, columns - sample.shape[1])), mode="edge")

    def terrain(first: int, last: int, left: int, right: int) -> NDArray:
        return np.ascontiguousarray(continued[first + 2 : last + 2, left:right])

    found = Mapper(predictor, device, precision).strips(terrain, sample.shape, (0, 0, *sample.shape))
    return np.concatenate([values for _, values in found], axis=1)


def _time_step(predictor: Predictor, size: tuple[int, int], device: torch.device, bf16: bool) -> float:
    import copy

    with torch.random.fork_rng():
        probe = copy.deepcopy(predictor).train()
        elevation = torch.randn(16, *size, device=device)
        best = float("inf")
        for _ in range(3):
            began = time.perf_counter()
            with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
                out = probe(elevation)
            out.float().square().mean().backward()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            best = min(best, time.perf_counter() - began)
    return best
