"""Sums of coefficient x cos(i)^p x cos(g)^q in one pass over memory, and their gradient in the coefficients in another."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from stages.common.threads import share_out

Powers = tuple[tuple[int, int], ...]  # (p, q) of every coefficient


def fits(coefficients: Tensor, cos_incidence: Tensor, cos_phase: Tensor, light: Tensor) -> bool:
    """Whether :func:`cosine_sum` takes these: float32 on the CPU, gradients in the coefficients alone.

    coefficients : (B, C, H, W); cos_incidence, cos_phase, light : (B, H, W)
    """
    geometry = cos_incidence, cos_phase, light
    if any(t.dtype != torch.float32 or t.device.type != "cpu" for t in (coefficients, *geometry)):
        return False
    if coefficients.ndim != 4 or any(t.requires_grad or t.shape != light.shape for t in geometry):
        return False
    return all(size in (1, full) for size, full in zip(coefficients[:, 0].shape, light.shape, strict=True))


def cosine_sum(coefficients: Tensor, cos_incidence: Tensor, cos_phase: Tensor, light: Tensor, powers: Powers) -> Tensor:
    """light x sum over k of coefficient k x cos(i)^p x cos(g)^q with (p, q) = powers[k]; differentiable in the coefficients.

    coefficients : (B, K, H, W) or what broadcasts to it, in any memory format; the rest : (B, H, W)
    """
    full = coefficients.expand(len(light), len(powers), *light.shape[1:])
    return _CosineSum.apply(full, cos_incidence, cos_phase, light, powers)


class _CosineSum(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, coefficients: Tensor, cos_incidence: Tensor, cos_phase: Tensor, light: Tensor, powers: Powers
    ) -> Tensor:
        known = tuple(t.contiguous() for t in (cos_incidence, cos_phase, light))
        ctx.save_for_backward(*known)
        # The gradient gets the coefficients' own memory format: to change it would be one more pass over memory.
        ctx.powers, ctx.like = powers, torch.empty_like(coefficients, device="meta")
        image = torch.empty_like(known[-1])
        add_up, _ = _kernels(powers)
        arrays = (t.numpy() for t in (coefficients.detach(), *known, image))
        share_out(add_up, len(image), *arrays)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        out = torch.empty_like(ctx.like, device="cpu")
        _, give_back = _kernels(ctx.powers)
        arrays = (t.numpy() for t in (gradients[0].contiguous(), *ctx.saved_tensors, out))
        share_out(give_back, len(out), *arrays)
        return out, None, None, None, None


@cache
def _kernels(powers: Powers) -> tuple[Callable[..., None], Callable[..., None]]:
    """Forward and backward. The powers are constants to the compiler, so that one vectorised loop along a row remains."""
    count = len(powers)

    @njit(nogil=True, cache=True)
    def add_up(first, last, coefficients, cos_incidence, cos_phase, light, image):
        for n in range(first, last):
            for r in range(image.shape[1]):
                mu0, phase, share, out = cos_incidence[n, r], cos_phase[n, r], light[n, r], image[n, r]
                for j in range(out.size):
                    total = np.float32(0)
                    for k in range(count):
                        term = coefficients[n, k, r, j]
                        for _ in range(powers[k][0]):
                            term *= mu0[j]
                        for _ in range(powers[k][1]):
                            term *= phase[j]
                        total += term
                    out[j] = np.float32(0) if share[j] == 0 else total * share[j]

    @njit(nogil=True, cache=True)
    def give_back(first, last, gradient, cos_incidence, cos_phase, light, out):
        for n in range(first, last):
            for r in range(light.shape[1]):
                mu0, phase, share, given = cos_incidence[n, r], cos_phase[n, r], light[n, r], gradient[n, r]
                for j in range(given.size):
                    for k in range(count):
                        term = given[j] * share[j]
                        for _ in range(powers[k][0]):
                            term *= mu0[j]
                        for _ in range(powers[k][1]):
                            term *= phase[j]
                        out[n, k, r, j] = term

    return add_up, give_back
