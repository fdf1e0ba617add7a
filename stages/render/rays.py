"""Rays of a camera's pixels, and where they meet the ground of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats, Floats32
from stages.physics.cameras.base import Camera
from stages.physics.cameras.distortion import NONE
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.maps.grid import CSM_CENTRE
from stages.render.motion import Moving
from stages.render.ray_points import sample_maps
from stages.render.raycast import HIT, MISS, Hits, cast
from stages.render.scene import Scene


@dataclass(frozen=True)
class Rays:
    """origins : (N, 3) or (1, 3), m; directions : (N, 3); hits : (N,), on the ground of the scene's layer (N,) uint8 or on its only one"""

    origins: Floats
    directions: Floats
    hits: Hits
    layer: NDArray[np.uint8] | None = None

    def part(self, index: NDArray[np.int64]) -> Rays:
        """Some of them; index : (n,)"""
        hits = Hits(*(getattr(self.hits, name)[index] for name in ("status", "depth", "row", "col")))
        return Rays(self.origins if len(self.origins) == 1 else self.origins[index], self.directions[index], hits)


def trace(camera: Camera, scene: Scene, first: int, count: int, samples: int) -> Rays:
    """Rays of ``count`` lines, ``samples`` x ``samples`` evenly spread over each pixel, in order of image position."""
    offset = (np.arange(samples) + 0.5) / samples + (CSM_CENTRE - 0.5)
    lines = (first + np.arange(count)[:, None] + offset).ravel()
    columns = (np.arange(camera.samples)[:, None] + offset).ravel()
    line, sample = np.meshgrid(lines, columns, indexing="ij")
    origins, directions = _rays(camera, line.ravel(), sample.ravel())
    base, *finer = (layer.ground for layer in scene.layers)
    hits = cast(base.field, origins, directions)
    if not finer:
        return Rays(origins, directions, hits)
    layer, (row, col) = np.zeros(len(directions), np.uint8), base.on_surface(hits)
    for number, ground in enumerate(finer, start=1):
        new = cast(ground.field, origins, directions)
        # what the coarser ground shows beyond the finer one's window may stand before it
        nearest = (hits.status != HIT) | ground.holds(row, col) | (new.depth < hits.depth)
        take = (new.status == HIT) & nearest
        there = ground.on_surface(new)
        row, col = np.where(take, there[0], row), np.where(take, there[1], col)
        names = ("status", "depth", "row", "col")
        hits = Hits(*(np.where(take, getattr(new, name), getattr(hits, name)) for name in names))
        layer[take] = number
    return Rays(origins, directions, hits, layer)


def invented(scene: Scene, rays: Rays) -> Floats32:
    """(N,) m that the refined ground at the hits stands above the surface's own bilinear one."""
    result = np.where(rays.hits.status == HIT, 0.0, np.nan).astype(np.float32)
    base, *finer = (layer.ground for layer in scene.layers)
    for number, ground in enumerate(finer, start=1):
        index = np.flatnonzero(rays.layer == number)
        hits = rays.part(index).hits
        row, col = ground.on_surface(hits)
        own = sample_maps(ground.field.elevation[None], hits.row, hits.col)[0]
        result[index] = own - sample_maps(base.field.elevation[None], row - base.window.row, col - base.window.col)[0]
    return result


def _rays(camera: Camera, line: Floats, sample: Floats) -> tuple[Floats, Floats]:
    """Like ``camera.rays``, with one origin where all rays leave one point."""
    at_once = not isinstance(camera, Moving) or camera.line_time == 0
    if isinstance(camera, Pinhole) and camera.distortion[0] == NONE and at_once:
        # by far the most common, and drawing rays should not take longer than casting them
        directions = np.empty((len(line), 3))
        _pinhole_rays(camera.focal_px, camera.principal_point_px, camera.rotation, line, sample, directions)
        return camera.centre[None], directions
    return camera.rays(line, sample)


@numba.njit(cache=True, parallel=True)
def _pinhole_rays(focal, point, rotation, line, sample, directions):
    for n in numba.prange(len(line)):
        x, y = (sample[n] - point[0]) / focal[0], (line[n] - point[1]) / focal[1]
        inverse = 1.0 / math.sqrt(x * x + y * y + 1.0)
        for k in range(3):
            directions[n, k] = (rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2]) * inverse


def in_space(scene: Scene, rays: Rays) -> NDArray[np.bool_]:
    """Rays that pass above everything there could be on the way."""
    missed = rays.hits.status == MISS
    if not missed.any():
        return missed
    single = len(rays.origins) == 1
    origins = rays.origins if single else rays.origins[missed]
    along = (origins * rays.directions[missed]).sum(-1)
    closest2 = (origins * origins).sum(-1) - along**2
    ground = scene.layers[0].ground
    lowest = ground.grid.radius + ground.field.lowest
    missed[missed] = (closest2 > lowest**2) | (along > 0)
    return missed
