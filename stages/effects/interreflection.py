"""Lit slopes light other slopes."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from stages.effects.base import Effect, register
from stages.physics.formation import State
from stages.physics.photometry import Parameter

CELLS = 32  # the crop is cut into this many cells a side: exchange of light is a smooth field


@register
class Interreflection(Effect):
    name = "interreflection"
    slot = "illumination"
    title = "light scattered by the terrain"
    mechanism = (
        "Sunlit slopes light their neighbours, most of all inside craters and in shadows. One bounce between diffuse facets of "
        "the scene's own reflectance, exchanged between cells of the crop; strength 1 is that light in full."
    )
    reference = "Shkuratov et al. (2005), Icarus 173, 3; form factors: Goral et al. (1984), SIGGRAPH 18, 213"
    confused_with = ("earthshine", "dark_bias")
    separate = "an image with the Sun so low that crater floors lie in shadow beside lit walls"
    parameters = (Parameter("strength", "1", -1.0, 5.0, 0.0, "share of the light that diffuse terrain would scatter"),)
    strong: ClassVar = {"strength": 1.5}

    def apply(self, state: State) -> None:
        strength = self.value("strength", state)
        state.further_light.append(lambda s: _add(s, strength))


def _add(state: State, strength: Tensor) -> None:
    mu0 = state.angles.cos_incidence
    # albedo of the same diffuse facets: what leaves a lit facet over what reaches it
    lit = mu0 > 0.2
    share = state.reflectance / mu0.clamp(min=0.2) * lit
    albedo = share.sum((-2, -1), keepdim=True) / lit.sum((-2, -1), keepdim=True).clamp(min=1)
    state.radiance = state.radiance + strength * albedo * received(
        state.elevation, state.radiance, state.observation.gsd
    )


def received(elevation: Tensor, radiance: Tensor, gsd: float) -> Tensor:
    """Light that the crop's facets receive from each other, as I/F of a white diffuse facet; (B, H, W)."""
    rows, columns = elevation.shape[-2:]
    factor = max(1, math.ceil(max(rows, columns) / CELLS))
    height = avg_pool2d(elevation[:, None], factor, ceil_mode=True)[:, 0]
    leaving = avg_pool2d(radiance[:, None], factor, ceil_mode=True)[:, 0].flatten(1)
    light = torch.empty_like(leaving)
    done = torch.zeros(len(height), dtype=torch.bool)
    for k in range(len(height)):
        if done[k]:
            continue
        same = (height == height[k]).flatten(1).all(1) & ~done
        light[same] = leaving[same] @ exchange(height[k].detach(), gsd * factor).T
        done |= same
    cells = light.view(len(height), 1, *height.shape[-2:])
    fine = interpolate(cells, scale_factor=factor, mode="bilinear", align_corners=False)[:, 0]
    return fine[:, :rows, :columns]


def exchange(height: Tensor, cell: float) -> Tensor:
    """Form factors between the cells of a height field, (N, N): the share of what j emits per area that reaches i.

    Seen or not is decided by both facets' horizons only; the ground between is ignored.
    """
    from stages.physics.geometry import slopes

    east, north = slopes(height, cell)
    inverse = torch.rsqrt(1 + east**2 + north**2)
    normal = torch.stack([-east * inverse, -north * inverse, inverse], -1).reshape(-1, 3)
    rows, columns = height.shape
    y, x = torch.meshgrid(torch.arange(rows) * -cell, torch.arange(columns) * cell, indexing="ij")
    place = torch.stack([x.float(), y.float(), height], -1).reshape(-1, 3)
    offset = place[None] - place[:, None]
    distance2 = (offset**2).sum(-1)
    area = cell * cell / inverse.reshape(-1)
    leaves = torch.einsum("ijk,ik->ij", offset, normal).clamp(min=0)
    arrives = -torch.einsum("ijk,jk->ij", offset, normal)
    return leaves * arrives.clamp(min=0) * area / (math.pi * distance2 * distance2 + area * area / math.pi + 1e-12)
