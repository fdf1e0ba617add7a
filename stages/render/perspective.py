"""Views of a terrain through a camera: rays, light and reflectance of every pixel, band by band of image lines."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numba
import numpy as np
import torch

from stages.common.arrays import Floats32
from stages.physics.cameras.base import Camera
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import masked_radiance_factor
from stages.physics.terrain.shading import BACKPLANES, Light
from stages.physics.terrain.sun_visibility import visible_share
from stages.physics.terrain.surface import Surface
from stages.render.motion import moments
from stages.render.ray_points import HitAngles, hit_angles, sample_maps
from stages.render.raycast import HIT, Hits
from stages.render.rays import Rays, in_space, invented, trace
from stages.render.scene import Layer, Scene

RAYS_AT_ONCE = 1 << 17  # arrays of them stay in a processor's cache


def render_view(surface: Surface, camera: Camera, light: Light, scene: Scene) -> Iterator[dict[str, Floats32]]:
    """Bands of image lines from the top down: ``image`` (I/F, mean over each pixel) and backplanes at pixel centres.

    NaN where the map is unknown; space is 0. Backplanes are NaN where there is no ground. ``image_std`` is among them where
    the scene has standard deviations: errors of the ground within a pixel are taken to be alike. ``exposed`` is there where
    the camera moves during its exposure: the mean image over it, while all others are those of its middle. ``invented`` are
    metres that detail adds to the surface, 0 where it is not refined.
    """
    poses = moments(camera, scene.distance)
    lines_at_once = max(1, RAYS_AT_ONCE // (camera.samples * scene.samples**2))
    for first in range(0, camera.lines, lines_at_once):
        count = min(lines_at_once, camera.lines - first)
        centre = trace(camera, scene, first, count, 1)
        seen = _see(surface, light, scene, centre)
        band = dict(zip(BACKPLANES, _backplanes(centre, seen), strict=True))
        if scene.deviation is not None:
            band["image_std"] = sample_maps(scene.deviation[None], centre.hits.row, centre.hits.col)[0]
        band["invented"] = invented(scene, centre)
        if scene.samples > 1:
            seen = _see(surface, light, scene, trace(camera, scene, first, count, scene.samples))
        band["image"] = _mean(seen.image, count, camera.samples, scene.samples)
        band["clipped"] = (_mean(seen.clipped, count, camera.samples, scene.samples) > 0).astype(np.float32)
        if len(poses) > 1:
            band["exposed"] = _exposed(surface, light, scene, poses, first, count)
        yield {k: v.reshape(count, camera.samples) for k, v in band.items()}


def _exposed(surface: Surface, light: Light, scene: Scene, poses: Sequence[Camera], first: int, count: int) -> Floats32:
    """(count, samples) I/F, mean over the poses of an exposure; what is unknown in one of them is unknown."""
    width, total = poses[0].samples, np.zeros(count * poses[0].samples)
    for pose in poses:
        seen = _see(surface, light, scene, trace(pose, scene, first, count, scene.samples))
        total += _mean(seen.image, count, width, scene.samples).ravel()
    return (total / len(poses)).astype(np.float32)


@dataclass(frozen=True)
class _Seen:
    """What rays see, (N,) each. visible : share of the Sun; image : I/F, NaN where unknown, 0 in space; clipped : above 0 where the model's I/F was below 0"""

    angles: HitAngles
    visible: Floats32
    image: Floats32
    clipped: Floats32


def _see(surface: Surface, light: Light, scene: Scene, rays: Rays) -> _Seen:
    """Light and reflectance where rays meet the ground, each on the layer that it meets."""
    if rays.layer is None:
        seen = _see_layer(surface, light, scene.layers[0], rays)
    else:
        whole = np.full((7, len(rays.directions)), np.nan, np.float32)
        for number, layer in enumerate(scene.layers):
            index = np.flatnonzero(rays.layer == number)
            part = _see_layer(surface, light, layer, rays.part(index))
            names = ("cos_incidence", "cos_emission", "phase", "sun_elevation")
            whole[:, index] = [*(getattr(part.angles, name) for name in names), part.visible, part.image, part.clipped]
        seen = _Seen(HitAngles(*whole[:4]), *whole[4:])
    seen.image[in_space(scene, rays)] = 0.0
    return seen


def _see_layer(surface: Surface, light: Light, layer: Layer, rays: Rays) -> _Seen:
    ground, hits = layer.ground, rays.hits
    angles = hit_angles(ground.field, rays.origins, rays.directions, hits, light.sun.position)
    if layer.horizon is None:
        visible = np.ones(len(rays.directions), np.float32)
    else:
        horizon = sample_maps(layer.horizon[None], hits.row, hits.col)[0]
        visible = visible_share(angles.sun_elevation, horizon, light.sun.radius)
    if layer.lit is not None:
        image, clipped = sample_maps(layer.lit, hits.row, hits.col)
    else:
        image, clipped = _reflected(surface, layer, hits, angles, visible)
    return _Seen(angles, visible, image, np.where(np.isfinite(image), clipped, 0))


def _reflected(
    surface: Surface, layer: Layer, hits: Hits, angles: HitAngles, visible: Floats32
) -> tuple[Floats32, Floats32]:
    """(N,) I/F at hits, NaN where unknown, and above 0 where the model's was below 0."""
    ground = layer.ground
    cosines = (torch.from_numpy(angles.cos_incidence), torch.from_numpy(angles.cos_emission))
    phase = torch.from_numpy(angles.phase)
    if ground.maps.shape[1] > 1:
        row, col = ((v + 0.5) / ground.finer - 0.5 for v in (hits.row, hits.col))
        coefficients = sample_maps(ground.maps, row, col)
    else:
        coefficients = np.ascontiguousarray(ground.maps[:, :, 0])
    parameters = surface.model.unpack(torch.from_numpy(coefficients), dim=0)
    image = masked_radiance_factor(surface.model, parameters, Angles(*cosines, phase.cos(), phase_given=phase)).numpy()
    clipped = (image < 0).astype(np.float32)
    image = np.maximum(image, 0) * visible
    if layer.added is not None:
        image += sample_maps(layer.added[None], hits.row, hits.col)[0]
    image[(hits.status != HIT) | ~np.isfinite(coefficients).all(axis=0)] = np.nan
    return image, clipped


def _mean(values: Floats32, lines: int, width: int, samples: int) -> Floats32:
    """(lines width samples^2,) of rays -> pixel means over the known ones; NaN where fewer than half are known."""
    if samples == 1:
        return values
    cells = values.reshape(lines, samples, width, samples)
    known = np.isfinite(cells)
    if known.all():
        return cells.mean(axis=(1, 3), dtype=np.float32)
    count = known.sum(axis=(1, 3))
    total = np.where(known, cells, 0).sum(axis=(1, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(2 * count >= samples**2, total / count, np.nan).astype(np.float32)


def _backplanes(rays: Rays, seen: _Seen) -> Floats32:
    """(planes, N) in the order of BACKPLANES."""
    angles, out = seen.angles, np.empty((len(BACKPLANES), len(seen.visible)), np.float32)
    _fill_backplanes(
        rays.origins, rays.directions, rays.hits.depth, angles.cos_incidence, angles.cos_emission, angles.phase,
        seen.visible, out,
    )  # fmt: skip
    return out


@numba.njit(cache=True, parallel=True)
def _fill_backplanes(origins, directions, depth, cos_incidence, cos_emission, phase, visible, out):
    stride = 0 if origins.shape[0] == 1 else 1
    degree = 180.0 / math.pi
    for n in numba.prange(len(depth)):
        if depth[n] != depth[n]:
            out[:, n] = np.nan
            continue
        x = origins[n * stride, 0] + depth[n] * directions[n, 0]
        y = origins[n * stride, 1] + depth[n] * directions[n, 1]
        z = origins[n * stride, 2] + depth[n] * directions[n, 2]
        out[0, n] = math.acos(min(max(cos_incidence[n], -1.0), 1.0)) * degree
        out[1, n] = math.acos(min(max(cos_emission[n], -1.0), 1.0)) * degree
        out[2, n] = phase[n] * degree
        out[3, n] = 1.0 - visible[n] if cos_incidence[n] > 0 else 1.0
        if cos_incidence[n] != cos_incidence[n]:
            out[0, n], out[3, n] = np.nan, np.nan
        if cos_emission[n] != cos_emission[n]:
            out[1, n] = np.nan
        out[4, n] = depth[n]
        out[5, n] = math.atan2(y, x) * degree
        out[6, n] = math.atan2(z, math.hypot(x, y)) * degree
