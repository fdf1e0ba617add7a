"""Lit slopes light other slopes."""

from __future__ import annotations

import math
import threading
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from stages.effects.base import Effect, register, telling_share
from stages.physics.formation.chain import State
from stages.physics.light.sky import form_factors
from stages.physics.photometry import Parameter

CELLS = 64  # the crop is cut into at most this many cells a side: exchange of light is a smooth field
AZIMUTHS = 12
STEPS = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0)  # cells
KEEP = 16  # pieces of ground whose form factors are kept, a few MB each


@register
class Interreflection(Effect):
    name = "interreflection"
    slot = "illumination"
    lights_shadows = True
    linear = True
    title = "light scattered by the terrain"
    mechanism = (
        "Sunlit slopes light their neighbours, most of all inside craters and in shadows. One bounce between diffuse facets that "
        "reflect as much as the ground at incidence 30, emission 0 and phase 30 deg (as `lunargr render` takes it), gathered over the "
        "terrain that each cell of the crop sees; strength 1 is that light in full."
    )
    reference = "Shkuratov et al. (2005), Icarus 173, 3; form factors: Goral et al. (1984), SIGGRAPH 18, 213"
    confused_with = ("earthshine", "dark_bias")
    separate = "an image with the Sun so low that crater floors lie in shadow beside lit walls"
    # towards the light both facets reflect twice as much as at 30 deg: strength 4
    parameters = (Parameter("strength", "1", -1.0, 10.0, 0.0, "share of the light that diffuse terrain would scatter"),)
    strong: ClassVar = {"strength": 1.0}
    tolerance: ClassVar = {"strength": 0.3}  # what relief that the DEM has not lights of its shadows

    def apply(self, state: State) -> None:
        strength = self.value("strength", state)
        state.further_light.append(lambda s: _add(s, strength))


def _add(state: State, strength: Tensor) -> None:
    albedo = state.albedo()
    leaving = albedo * state.angles.cos_incidence.clamp(min=0)
    if state.sun_visibility is not None:
        leaving = leaving * state.sun_visibility
    # relief finer than the DEM lights sunlit ground as much again
    light = albedo * received(state.elevation, leaving, state.observation.gsd) * telling_share(state)
    state.radiance = state.radiance + strength * light


def received(elevation: Tensor, radiance: Tensor, gsd: float) -> Tensor:
    """Light that the crop's facets receive from each other, as I/F of a white diffuse facet; (B, H, W).

    Crops of one piece of ground share the geometry. Terrain outside the crop is its mirror image.
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
    """Irradiance over pi times the solar flux from all visible terrain; height (H, W), leaving (n, H, W) I/F -> (n, H, W)."""
    factors = kept_factors(height, cell).to(leaving)
    return torch.sparse.mm(factors, leaving.flatten(1).T).T.reshape(leaving.shape)


def kept_factors(height: Tensor, cell: float) -> Tensor:
    """Share of its whole sky that each facet sees filled by each other one, times the cosine; sparse, (H W, H W).

    The last few pieces of ground are kept, since the same one is lit again and again. height : (H, W), m; cell : m
    """
    key = (tuple(height.shape), cell, height.cpu().numpy().tobytes())
    with _lock:
        factors = _kept.get(key)
    if factors is None:
        starts, places, shares = form_factors(height.cpu().numpy(), cell, AZIMUTHS, np.array(STEPS))
        rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        entries = torch.from_numpy(np.stack([rows, places]))
        size = (height.numel(), height.numel())
        factors = torch.sparse_coo_tensor(entries, torch.from_numpy(shares), size, check_invariants=False).coalesce()
        factors = factors.to(height.device)
        with _lock:
            while len(_kept) >= KEEP:
                _kept.pop(next(iter(_kept)))
            _kept[key] = factors
    return factors


_kept: dict[tuple, Tensor] = {}
_lock = threading.Lock()  # sites are worked on side by side
