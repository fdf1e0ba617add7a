"""Views of a terrain through a camera: rays, light and reflectance of every pixel, band by band of image lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from stages.common.arrays import Floats, Floats32
from stages.physics.cameras.base import Camera
from stages.physics.cameras.distortion import NONE
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.formation.geometry import Angles
from stages.physics.maps.grid import CSM_CENTRE
from stages.physics.maps.window import Window
from stages.physics.photometry import masked_radiance_factor
from stages.physics.terrain.shading import (
    BACKPLANES,
    HALO_PX,
    Light,
    form_window,
    further_radiance,
    image_deviation,
)
from stages.physics.terrain.sun_visibility import visible_share
from stages.physics.terrain.surface import Surface
from stages.render.grounds import Ground, Grounds
from stages.render.motion import Moving, moments
from stages.render.ray_points import HitAngles, hit_angles, sample_maps
from stages.render.raycast import HIT, MISS, Hits, cast
from stages.render.sight import seen_window
from stages.render.viewpoint import pixel_footprint

RAYS_AT_ONCE = 1 << 17  # arrays of them stay in a processor's cache
BLOCK_PX = 512  # of further light at once


@dataclass(frozen=True)
class Scene:
    """What a camera sees of a surface in some light.

    horizon : (h, w), rad, or None
    lit : (2, h, w) I/F where extensions have shaded the ground beforehand, and where it was clipped at 0; or None
    added : (h, w) I/F that the Earth and the terrain around add, or None
    samples : rays per pixel and axis; distance : from the camera to the ground, m
    pixels_per_post : image pixels along one pixel of the map, at that distance
    deviation : (h, w) I/F, standard deviation of photographs about the ground's I/F, or None where it is not asked for
    """

    ground: Ground
    horizon: Floats32 | None
    lit: Floats32 | None
    added: Floats32 | None
    samples: int
    distance: float
    pixels_per_post: float
    deviation: Floats32 | None = None


def make_scene(
    surface: Surface,
    camera: Camera,
    light: Light,
    relief: tuple[float, float],
    samples: int | None,
    errors: bool = False,
    grounds: Grounds | None = None,
) -> Scene:
    """Read and prepare what a camera sees, with its standard deviations if ``errors``. Raises GeometryError.

    relief : lowest and highest elevation, m; samples : see :func:`seen_window`; grounds : of earlier views
    """
    window, samples, factor, distance = seen_window(surface, camera, relief, samples)
    finer = surface.grid.gsd / pixel_footprint(camera, distance)
    window = window.widened(factor, surface.elevation.shape)
    if errors or light.extensions or light.earthshine is not None or light.bounce is not None:
        grounds = None  # light that depends on the camera's place is worth computing for what it sees only
    ground = (grounds or Grounds(surface)).over(window, factor)
    around = window.padded(HALO_PX, surface.elevation.shape) if light.extensions else window
    lit, added = None, _added(surface, light, around)
    if light.extensions:
        # the sensor comes last: its effects act on the camera's image, not on the ground
        before = replace(light, extensions=[e for e in light.extensions if e.slot != "sensor"])
        lit, added = np.stack(form_window(surface, before, window, added)), None
    deviation = _blocks(window, lambda b: _deviation(surface, light, b, lit, window)) if errors else None
    # errors of neighbours are alike: the deviation of a mean is the mean of theirs
    lit, added, deviation = (None if v is None else ground.coarse(v) for v in (lit, added, deviation))
    return Scene(ground, ground.horizon(light.horizon), lit, added, samples, distance, finer, deviation)


def _added(surface: Surface, light: Light, window: Window) -> Floats32 | None:
    """(h, w) I/F that further light adds; None without such light."""
    if light.earthshine is None and light.bounce is None:
        return None
    return _blocks(window, lambda block: further_radiance(surface, light, block)[0])


def _deviation(surface: Surface, light: Light, block: Window, lit: Floats32 | None, window: Window) -> Floats32:
    """(h, w) I/F of a block of the window, standard deviation; lit : of the window, as in ``Scene``."""
    return image_deviation(surface, light, block, None if lit is None else lit[0][block.within(window).part])


def _blocks(window: Window, field: Callable[[Window], Floats32 | None]) -> Floats32:
    """(h, w) of the window, a field drawn block by block."""
    result = np.empty((window.height, window.width), np.float32)
    for r in range(0, window.height, BLOCK_PX):
        for c in range(0, window.width, BLOCK_PX):
            height, width = min(BLOCK_PX, window.height - r), min(BLOCK_PX, window.width - c)
            block = Window(window.row + r, window.col + c, height, width)
            result[block.within(window).part] = field(block)
    return result


def render_view(surface: Surface, camera: Camera, light: Light, scene: Scene) -> Iterator[dict[str, Floats32]]:
    """Bands of image lines from the top down: ``image`` (I/F, mean over each pixel) and backplanes at pixel centres.

    NaN where the map is unknown; space is 0. Backplanes are NaN where there is no ground. ``image_std`` is among them where
    the scene has standard deviations: errors of the ground within a pixel are taken to be alike. ``exposed`` is there where
    the camera moves during its exposure: the mean image over it, while all others are those of its middle.
    """
    poses = moments(camera, scene.distance)
    lines_at_once = max(1, RAYS_AT_ONCE // (camera.samples * scene.samples**2))
    for first in range(0, camera.lines, lines_at_once):
        count = min(lines_at_once, camera.lines - first)
        centre = _trace(camera, scene, first, count, 1)
        light_there = _light_at(light, scene, centre)
        band = dict(zip(BACKPLANES, _backplanes(centre, *light_there), strict=True))
        if scene.deviation is not None:
            band["image_std"] = sample_maps(scene.deviation[None], centre.hits)[0]
        fine = centre
        if scene.samples > 1:
            fine = _trace(camera, scene, first, count, scene.samples)
            if scene.lit is None:
                light_there = _light_at(light, scene, fine)
        radiance, clipped = _radiance(surface, scene, fine, light_there)
        band["image"] = _mean(radiance, count, camera.samples, scene.samples)
        band["clipped"] = (_mean(clipped, count, camera.samples, scene.samples) > 0).astype(np.float32)
        if len(poses) > 1:
            band["exposed"] = _exposed(surface, light, scene, poses, first, count)
        yield {k: v.reshape(count, camera.samples) for k, v in band.items()}


def _exposed(surface: Surface, light: Light, scene: Scene, poses: Sequence[Camera], first: int, count: int) -> Floats32:
    """(count, samples) I/F, mean over the poses of an exposure; what is unknown in one of them is unknown."""
    width, total = poses[0].samples, np.zeros(count * poses[0].samples)
    for pose in poses:
        rays = _trace(pose, scene, first, count, scene.samples)
        radiance, _ = _radiance(surface, scene, rays, _light_at(light, scene, rays))
        total += _mean(radiance, count, width, scene.samples).ravel()
    return (total / len(poses)).astype(np.float32)


@dataclass(frozen=True)
class _Rays:
    """origins : (N, 3) or (1, 3), m; directions : (N, 3); hits : (N,)"""

    origins: Floats
    directions: Floats
    hits: Hits


def _trace(camera: Camera, scene: Scene, first: int, count: int, samples: int) -> _Rays:
    """Rays of ``count`` lines, ``samples`` x ``samples`` evenly spread over each pixel, in order of image position."""
    offset = (np.arange(samples) + 0.5) / samples + (CSM_CENTRE - 0.5)
    lines = (first + np.arange(count)[:, None] + offset).ravel()
    columns = (np.arange(camera.samples)[:, None] + offset).ravel()
    line, sample = np.meshgrid(lines, columns, indexing="ij")
    origins, directions = _rays(camera, line.ravel(), sample.ravel())
    return _Rays(origins, directions, cast(scene.ground.field, origins, directions))


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


def _light_at(light: Light, scene: Scene, rays: _Rays) -> tuple[HitAngles, Floats32]:
    """Angles and visible share of the Sun at the hits, (N,)."""
    angles = hit_angles(scene.ground.field, rays.origins, rays.directions, rays.hits, light.sun.position)
    if scene.horizon is None:
        return angles, np.ones(len(rays.directions), np.float32)
    horizon = sample_maps(scene.horizon[None], rays.hits)[0]
    return angles, visible_share(angles.sun_elevation, horizon, light.sun.radius)


def _radiance(
    surface: Surface, scene: Scene, rays: _Rays, light_there: tuple[HitAngles, Floats32]
) -> tuple[Floats32, Floats32]:
    """(N,) I/F along rays: NaN where unknown, 0 in space; and (N,) above 0 where the model's I/F was clipped at 0.

    light_there : of the rays' hits, as :func:`_light_at` gives it; of no use where extensions have lit the ground
    """
    if scene.lit is not None:
        image, clipped = sample_maps(scene.lit, rays.hits)
    else:
        found, visible = light_there
        cosines = (torch.from_numpy(found.cos_incidence), torch.from_numpy(found.cos_emission))
        phase = torch.from_numpy(found.phase)
        angles = Angles(*cosines, phase.cos(), phase_given=phase)
        if scene.ground.maps.shape[1] > 1:
            coefficients = sample_maps(scene.ground.maps, rays.hits)
        else:
            coefficients = np.ascontiguousarray(scene.ground.maps[:, :, 0])
        parameters = surface.model.unpack(torch.from_numpy(coefficients), dim=0)
        image = masked_radiance_factor(surface.model, parameters, angles).numpy()
        clipped = (image < 0).astype(np.float32)
        image = np.maximum(image, 0) * visible
        if scene.added is not None:
            image += sample_maps(scene.added[None], rays.hits)[0]
        image[(rays.hits.status != HIT) | ~np.isfinite(coefficients).all(axis=0)] = np.nan
    image[_in_space(scene, rays)] = 0.0
    return image, np.where(np.isfinite(image), clipped, 0)


def _in_space(scene: Scene, rays: _Rays) -> NDArray[np.bool_]:
    """Rays that pass above everything there could be on the way."""
    missed = rays.hits.status == MISS
    if not missed.any():
        return missed
    single = len(rays.origins) == 1
    origins = rays.origins if single else rays.origins[missed]
    along = (origins * rays.directions[missed]).sum(-1)
    closest2 = (origins * origins).sum(-1) - along**2
    missed[missed] = (closest2 > (scene.ground.grid.radius + scene.ground.field.lowest) ** 2) | (along > 0)
    return missed


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


def _backplanes(rays: _Rays, angles: HitAngles, visible: Floats32) -> Floats32:
    """(planes, N) in the order of BACKPLANES."""
    out = np.empty((len(BACKPLANES), len(visible)), np.float32)
    _fill_backplanes(
        rays.origins, rays.directions, rays.hits.depth, angles.cos_incidence, angles.cos_emission, angles.phase,
        visible, out,
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
