"""Sums over the crops of a batch that do not depend on the number of threads: pieces of a fixed number of crops, a thread each.

Only inside ``stages.common.threads.one_thread_each``, on the CPU; elsewhere these are PyTorch's own operators.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from stages.common.threads import in_pieces, share_out
from stages.network.cpu.training_kernels import channels_last, empty

PIECE = 4  # crops
Found = TypeVar("Found")


def _cut(x: Tensor) -> bool:
    return in_pieces() and x.device.type == "cpu"


def _each_piece(count: int, work: Callable[[int, int], Found]) -> list[Found]:
    """What ``work(first, last)`` gives for the pieces of ``count`` crops, in order; the pieces are shared out."""
    pieces = [(first, min(count, first + PIECE)) for first in range(0, count, PIECE)]
    found: dict[int, Found] = {}

    def run(start: int, stop: int) -> None:
        with torch.autocast("cpu", enabled=False):
            for k in range(start, stop):
                found[k] = work(*pieces[k])

    share_out(run, len(pieces))
    return [found[k] for k in range(len(pieces))]


def convolution(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``conv2d`` without padding. x : (B, I, H, W); weight : (O, I, h, w); bias : (O,)"""
    if not _cut(x):
        return functional.conv2d(x, weight, bias)
    if torch.is_autocast_enabled("cpu"):
        kind = torch.get_autocast_dtype("cpu")
        x, weight = x.to(kind), weight.to(kind)
        bias = None if bias is None else bias.to(kind)
    return _Convolution.apply(x, weight, bias)


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        x = channels_last(x)
        ctx.save_for_backward(x, weight)
        ctx.biased = bias is not None
        rows, columns = (x.shape[k] - weight.shape[k] + 1 for k in (2, 3))
        out = empty(len(x), len(weight), rows, columns, x.dtype)

        @torch.no_grad()
        def work(a: int, b: int) -> None:
            out[a:b] = functional.conv2d(x[a:b], weight, bias)

        _each_piece(len(x), work)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        dy = channels_last(gradients[0])
        wanted = [ctx.needs_input_grad[0], ctx.needs_input_grad[1], ctx.biased and ctx.needs_input_grad[2]]
        dx = torch.empty_like(x) if wanted[0] else None

        @torch.no_grad()
        def work(a: int, b: int) -> tuple[Tensor, Tensor]:
            own_dx, own_dweight, own_dbias = torch.ops.aten.convolution_backward(
                dy[a:b], x[a:b], weight, [len(weight)], [1, 1], [0, 0], [1, 1], False, [0, 0], 1, wanted
            )
            if dx is not None:
                dx[a:b] = own_dx
            return own_dweight, own_dbias

        dweights, dbiases = zip(*_each_piece(len(x), work), strict=True)
        dweight = _sum(dweights) if wanted[1] else None
        dbias = _sum(dbiases) if wanted[2] else None
        return dx, dweight, dbias


def _sum(parts: Sequence[Tensor]) -> Tensor:
    """In order, in float32 at least."""
    total = parts[0].float()
    for part in parts[1:]:
        total = total + part.float()
    return total.to(parts[0].dtype)


Objective = Callable[..., tuple[Tensor, Tensor]]


def sum_over_crops(objective: Objective, *tensors: Tensor) -> tuple[Tensor, Tensor]:
    """Two sums over all crops, one to minimise and one to report, of ``objective(first, last, *tensors of these crops)``.

    tensors : (B, ...) each; only the first sum has a gradient in them
    """
    count = len(tensors[0])
    if not _cut(tensors[0]):
        return objective(0, count, *tensors)
    value, reported = _SumOverCrops.apply(objective, *tensors)
    return value, reported


class _SumOverCrops(torch.autograd.Function):
    """Works out the gradients along with the value: a piece's own graph lives only while it is worked on."""

    @staticmethod
    def forward(ctx: Any, objective: Objective, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        found = _each_piece(len(tensors[0]), lambda first, last: _piece(objective, first, last, tensors))
        values, reports, gradients = zip(*found, strict=True)
        ctx.gradients = [None if parts[0] is None else torch.cat(parts) for parts in zip(*gradients, strict=True)]
        reported = _sum(reports)
        ctx.mark_non_differentiable(reported)
        return _sum(values), reported

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, *(None if g is None else g * gradients[0] for g in ctx.gradients)


def _piece(objective: Objective, a: int, b: int, tensors: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, list]:
    learning = any(t.requires_grad for t in tensors)
    with torch.set_grad_enabled(learning):
        own = [t[a:b].detach().requires_grad_(t.requires_grad) for t in tensors]
        value, reported = objective(a, b, *own)
        learned = [t for t in own if t.requires_grad]
        slopes = iter(torch.autograd.grad(value, learned, allow_unused=True) if learned else ())
    return value.detach(), reported.detach(), [next(slopes) if t.requires_grad else None for t in own]
