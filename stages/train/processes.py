"""Several processes that train one network together, started by ``torchrun``; a single one needs none of this."""

from __future__ import annotations

import math

import torch
import torch.distributed as dist
from torch import Tensor

from schemas.command_line import count_processes
from schemas.errors import ConfigError


def join_group() -> tuple[int, int]:
    """(rank, number of processes); starts the process group under torchrun."""
    ranks, _ = count_processes()
    if ranks == 1:
        return 0, 1
    if not dist.is_initialized():
        try:
            dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        except (ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:160]
            raise ConfigError(
                f"WORLD_SIZE: expected {ranks} processes that torchrun started, could not join them ({reason}); "
                "use torchrun or unset it."
            ) from None
    return dist.get_rank(), ranks


def share_buffers(module: torch.nn.Module, ranks: int) -> None:
    """Give all processes the first one's running statistics, by which evaluation normalises."""
    for buffer in module.buffers() if ranks > 1 else ():
        dist.broadcast(buffer, 0)


def sum_over_ranks(values: Tensor, ranks: int) -> Tensor:
    """The sum over all processes, in place; values : any shape."""
    if ranks > 1:
        dist.all_reduce(values)
    return values


def mean_over_ranks(total: float, weight: float, ranks: int, device: torch.device) -> float:
    """Weighted mean over all processes; NaN without weight."""
    sums = sum_over_ranks(torch.tensor([total, weight], dtype=torch.float64, device=device), ranks)
    return float(sums[0] / sums[1]) if sums[1] > 0 else math.nan
