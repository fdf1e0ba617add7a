"""Losses on valid pixels, and the per-image gain and offset of uncalibrated images."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


def squared_error(predicted: Tensor, measured: Tensor, valid: Tensor) -> Tensor:
    """Sum of squared errors over valid pixels; its gradient is that in ``predicted`` only.

    predicted, measured, valid : (B, H, W), in the same unit
    """
    return _SquaredError.apply(predicted, measured, valid)


class _SquaredError(torch.autograd.Function):
    """The residual, 0 where invalid, is kept as the gradient: one pass over memory, where autograd takes four."""

    @staticmethod
    def forward(ctx: Any, predicted: Tensor, measured: Tensor, valid: Tensor) -> Tensor:
        residual = (predicted - measured).mul_(valid)
        ctx.save_for_backward(residual)
        return (residual * residual).sum()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (residual,) = ctx.saved_tensors
        return residual * (2 * gradients[0]), None, None


def crop_errors(predicted: Tensor, measured: Tensor, valid: Tensor, brightness: float) -> tuple[Tensor, Tensor]:
    """Sums over crops (B, H, W): of squared errors less most of the part that a gain of the crop would explain, and of
    all.

    ``brightness`` is the share of that part that stays, so that the overall level remains determined. Albedo that
    terrain does not show changes whole crops together: generalised least squares weights errors with a common factor
    per crop so.
    """
    if brightness == 1:
        error = squared_error(predicted, measured, valid)
        return error, error.detach()
    seen = predicted * valid
    residual = seen - measured * valid
    error = residual.square().sum(dim=(1, 2))
    along = (residual * seen).sum(dim=(1, 2)).square() / seen.square().sum(dim=(1, 2)).clamp(min=1e-12)
    return (error - (1 - brightness) * along).sum(), error.detach().sum()


class Radiometry(nn.Module):
    """measured = gain x I/F + offset, per image; the identity for calibrated images.

    Gains keep their geometric mean: a factor on all of them cannot be distinguished from one on the albedo.
    """

    def __init__(self, gain: Tensor, offset: Tensor, calibrated: bool) -> None:
        super().__init__()
        self.calibrated = calibrated
        scale = torch.ones(()) if calibrated else gain.log().mean().exp()
        self.scale: Tensor
        self.register_buffer("scale", scale)
        self.log_gain = nn.Parameter((gain / scale).log(), requires_grad=not calibrated)
        self.shift = nn.Parameter(offset / scale, requires_grad=not calibrated)

    def gain(self) -> Tensor:
        """(F,) of each image."""
        return self.scale * (self.log_gain - self.log_gain.mean()).exp()

    def offset(self) -> Tensor:
        """(F,) of each image."""
        return self.scale * self.shift

    def crop_gains(self, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Gain and offset, (B, 1, 1) each, of crops from frames (B,), over ``scale``: residuals then read like I/F."""
        gain = (self.log_gain - self.log_gain.mean()).exp()
        return gain[frame, None, None], self.shift[frame, None, None]
