"""From a network's output to the parameters of a reflectance model: some as maps, the others the same everywhere."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from stages.physics.photometry import ReflectanceModel

SLOPE = 0.01  # of the LeakyReLU that keeps coefficients nearly positive in Lunar-G2R


class CoefficientMaps(nn.Module):
    """All parameters of ``model``: those named in ``maps`` from the network, the others learned as one number each.

    Every parameter stays within its bounds, or nearly positive (LeakyReLU, as in Lunar-G2R) where ``positive``. The
    network's output is scaled by ``output_scale`` and shifted by the start, so that training begins at the uniform surface
    ``start`` (C,) and moves in steps of its own size.

    deviations : whether the network also gives the logarithm of each map's standard deviation, after all the maps
    """

    def __init__(
        self,
        model: ReflectanceModel,
        maps: Sequence[str],
        start: Tensor,
        output_scale: float,
        positive: bool = False,
        deviations: bool = False,
    ) -> None:
        super().__init__()
        self.model, self.positive, self.output_scale = model, positive, output_scale
        self.names = [p.name for p in model.parameters]
        self.maps = model.choose_maps(maps)
        self.global_names = tuple(name for name in self.names if name not in self.maps)
        raw = dict(zip(self.names, self._unbound(start), strict=True))
        self.start: Tensor
        self.rest_start: Tensor  # of the global parameters; files have the name
        shifts = [float(raw[n]) for n in self.maps]
        self.channels = len(shifts) * (2 if deviations else 1)
        self.register_buffer("start", torch.tensor(shifts + [0.0] * (self.channels - len(shifts))))
        self.register_buffer("rest_start", torch.tensor([float(raw[n]) for n in self.global_names]))
        self.rest_shift = nn.Parameter(torch.zeros(len(self.global_names)), requires_grad=bool(self.global_names))

    def _unbound(self, start: Tensor) -> Tensor:
        if self.positive:
            return torch.where(start >= 0, start, start / SLOPE)
        return self.model.unconstrain(start, dim=0)

    def _bounded(self, raw: Tensor, dim: int, names: Sequence[str]) -> Tensor:
        return leaky_relu(raw, SLOPE) if self.positive else self.model.constrain(raw, dim, names)

    def global_values(self) -> dict[str, Tensor]:
        """The parameters that are the same everywhere, by name, each ()."""
        values = self._bounded(self.rest_start + self.rest_shift * self.output_scale, 0, self.global_names)
        return dict(zip(self.global_names, values.unbind(0), strict=True))

    def unbounded(self, output: Tensor) -> Tensor:
        """The network's output (B, channels, H, W), scaled and shifted to the start: maps before their bounds."""
        return output.float() * self.output_scale + self.start[:, None, None]

    def combine(self, unbounded: Tensor) -> Tensor | dict[str, Tensor]:
        """The coefficients as ``formation.chain.form`` takes them. unbounded : (B, channels, H, W)"""
        bounded = self._bounded(unbounded.narrow(1, 0, len(self.maps)), 1, self.maps)
        if not self.global_names:
            return bounded
        return dict(zip(self.maps, bounded.unbind(1), strict=True)) | self.global_values()

    def stack(self, unbounded: Tensor, dim: int) -> Tensor:
        """All parameters along ``dim``, in the model's order.

        unbounded : (B, channels, H, W) with dim 1, or alike; returns (B, C, H, W)
        """
        bounded = self._bounded(unbounded.narrow(dim, 0, len(self.maps)), dim, self.maps)
        if not self.global_names:
            return bounded
        maps = dict(zip(self.maps, bounded.unbind(dim), strict=True))
        like = next(iter(maps.values()))
        found = maps | {name: value.to(like.dtype).expand_as(like) for name, value in self.global_values().items()}
        return torch.stack([found[name] for name in self.names], dim=dim)

    def deviations(self, unbounded: Tensor, dim: int) -> Tensor:
        """Standard deviations of the maps along ``dim``, in the maps' order; at most half of a parameter's range.

        unbounded : (B, channels, H, W) with dim 1, or alike; returns (B, M, H, W)
        """
        count = len(self.maps)
        half = [(p.upper - p.lower) / 2 for p in self.model.parameters if p.name in self.maps]
        shape = [1] * unbounded.ndim
        shape[dim] = count
        limit = torch.tensor(half, dtype=unbounded.dtype, device=unbounded.device).view(shape)
        return torch.minimum(unbounded.narrow(dim, count, self.channels - count).exp(), limit)
