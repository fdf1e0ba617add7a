"""Lit slopes light other slopes."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from stages.effects.base import Effect, register
from stages.physics import geometry
from stages.physics.formation import State
from stages.physics.photometry import Parameter

CELLS = 64  # the crop is cut into at most this many cells a side: exchange of light is a smooth field
AZIMUTHS = 12
STEPS = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0)  # cells


@register
class Interreflection(Effect):
    name = "interreflection"
    slot = "illumination"
    linear = True
    title = "light scattered by the terrain"
    mechanism = (
        "Sunlit slopes light their neighbours, most of all inside craters and in shadows. One bounce between diffuse facets of "
        "the scene's own reflectance, gathered over the terrain that each cell of the crop sees; strength 1 is that light in full."
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
    """Light that the crop's facets receive from each other, as I/F of a white diffuse facet; (B, H, W).

    Crops of one piece of ground share the geometry. Terrain outside the crop is dark.
    """
    rows, columns = elevation.shape[-2:]
    factor = max(1, math.ceil(max(rows, columns) / CELLS))
    height = avg_pool2d(elevation[:, None], factor, ceil_mode=True)[:, 0]
    leaving = avg_pool2d(radiance[:, None], factor, ceil_mode=True)[:, 0]
    light = torch.empty_like(leaving)
    done = torch.zeros(len(height), dtype=torch.bool)
    for k in range(len(height)):
        if done[k]:
            continue
        same = (height == height[k]).flatten(1).all(1) & ~done
        light[same] = gather(height[k].detach(), leaving[same], gsd * factor)
        done |= same
    fine = interpolate(light[:, None], scale_factor=factor, mode="bilinear", align_corners=False)[:, 0]
    return fine[:, :rows, :columns]


def gather(height: Tensor, leaving: Tensor, cell: float) -> Tensor:
    """Irradiance over pi times the solar flux from all visible terrain; height (H, W), leaving (n, H, W) I/F -> (n, H, W).

    Each azimuth is walked outwards from the facet's own plane: what rises above all before it is seen, and lights the
    facet by the solid angle that it adds times the cosine of its incidence.
    """
    rows, columns = height.shape
    east, north = geometry.slopes(height, cell)
    up = torch.rsqrt(1 + east**2 + north**2)
    total = torch.zeros_like(leaving)
    for k in range(AZIMUTHS):
        azimuth = 2 * math.pi * (k + 0.5) / AZIMUTHS
        to_east, to_north = math.sin(azimuth), math.cos(azimuth)
        level = -(east * to_east + north * to_north) * up  # the normal along the azimuth
        highest = torch.atan2(-level, up)
        for step in STEPS:
            right, down = round(step * to_east), round(-step * to_north)
            here_r, there_r = _overlap(rows, down)
            here_c, there_c = _overlap(columns, right)
            if here_r.stop <= here_r.start or here_c.stop <= here_c.start:
                break
            here, there = (here_r, here_c), (there_r, there_c)
            distance = math.hypot(right, down) * cell
            angle = torch.atan((height[there] - height[here]) / distance)
            before = highest[here]
            top = torch.maximum(angle, before)
            # the integral of cos(incidence) cos(h) over h from before to top
            share = 0.5 * level[here] * ((top - before) + torch.sin(top - before) * torch.cos(top + before))
            share = share + 0.5 * up[here] * (torch.sin(top) ** 2 - torch.sin(before) ** 2)
            total[:, here_r, here_c] += share * leaving[:, there_r, there_c]
            highest[here] = top
    return total * (2 / AZIMUTHS)


def _overlap(count: int, shift: int) -> tuple[slice, slice]:
    """Places whose neighbour ``shift`` further on exists, and those neighbours."""
    return slice(max(0, -shift), min(count, count - shift)), slice(max(0, shift), min(count, count + shift))
