"""What a camera sees of a surface in some light, read and prepared before rays are cast."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.common.arrays import Floats32
from stages.physics.cameras.base import Camera
from stages.physics.maps.window import Window
from stages.physics.terrain.shading import (
    HALO_PX,
    Light,
    form_window,
    further_radiance,
    image_deviation,
)
from stages.physics.terrain.surface import Surface
from stages.render.grounds import Ground, Grounds
from stages.render.sight import finer_windows, seen_window
from stages.render.viewpoint import pixel_footprint

BLOCK_PX = 512  # of further light at once


@dataclass(frozen=True)
class Layer:
    """Ground at one resolution, in some light.

    horizon : (h, w), rad, or None
    lit : (2, h, w) I/F where extensions have shaded the ground beforehand, and where it was clipped at 0; or None
    added : (h, w) I/F that the Earth and the terrain around add, or None
    """

    ground: Ground
    horizon: Floats32 | None
    lit: Floats32 | None = None
    added: Floats32 | None = None


@dataclass(frozen=True)
class Scene:
    """What a camera sees of a surface in some light.

    layers : all that it sees, then what it sees with more than one pixel to one of the surface, ever finer
    samples : rays per pixel and axis; distance : from the camera to the ground, m
    pixels_per_post : image pixels along one pixel of the map, at that distance
    deviation : (h, w) I/F, standard deviation of photographs about the ground's I/F, or None where it is not asked for
    """

    layers: Sequence[Layer]
    samples: int
    distance: float
    pixels_per_post: float
    deviation: Floats32 | None = None


def make_scene(
    grounds: Grounds,
    camera: Camera,
    light: Light,
    relief: tuple[float, float],
    samples: int | None,
    errors: bool = False,
) -> Scene:
    """Read and prepare what a camera sees, with its standard deviations if ``errors``. Raises GeometryError.

    relief : lowest and highest elevation, m; samples : see :func:`seen_window`; grounds : kept for later views
    """
    surface = grounds.surface
    window, samples, factor, distance = seen_window(surface, camera, relief, samples)
    finer = surface.grid.gsd / pixel_footprint(camera, distance)
    window = window.widened(factor, surface.elevation.shape)
    if errors or light.extensions or light.earthshine is not None or light.bounce is not None:
        grounds = Grounds(surface)  # light that depends on the camera's place is worth computing for what it sees only
    ground = grounds.over(window, factor)
    around = window.padded(HALO_PX, surface.elevation.shape) if light.extensions else window
    lit, added = None, _added(surface, light, around)
    if light.extensions:
        # the sensor comes last: its effects act on the camera's image, not on the ground
        before = replace(light, extensions=[e for e in light.extensions if e.slot != "sensor"])
        lit, added = np.stack(form_window(surface, before, window, added)), None
    deviation = _blocks(window, lambda b: _deviation(surface, light, b, lit, window)) if errors else None
    # errors of neighbours are alike: the deviation of a mean is the mean of theirs
    lit, added, deviation = (None if v is None else ground.coarse(v) for v in (lit, added, deviation))
    layers = [Layer(ground, ground.horizon(light), lit, added)]
    if grounds.refined is not None and factor == 1:
        for part, level in finer_windows(camera, ground, surface):
            refined = grounds.over(part, finer=level)
            layers.append(Layer(refined, refined.horizon(light)))
    return Scene(layers, samples, distance, finer, deviation)


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
