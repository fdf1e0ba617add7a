"""Shading a map on its own grid, block by block: I/F and backplanes of any window, in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from stages.common.arrays import Floats32
from stages.physics.formation.chain import Extension, Observation, State, form
from stages.physics.maps.window import Window
from stages.physics.photometry import masked_radiance_factor
from stages.physics.photometry.deviation import radiance_deviation
from stages.physics.terrain.block_geometry import BlockGeometry, block_geometry
from stages.physics.terrain.further_light import Bounce, Earthshine, Horizon
from stages.physics.terrain.sun import Sun
from stages.physics.terrain.sun_visibility import visible_share
from stages.physics.terrain.surface import SHADOWED, Surface

BACKPLANES = ("incidence_deg", "emission_deg", "phase_deg", "shadow", "depth", "longitude_deg", "latitude_deg")
TILE_PX = 128  # extensions were fitted to crops about this large, each with its own tangent plane
HALO_PX = 16
STRAIGHT_ABOVE = 1e8  # m: from here every pixel of a tile is seen from straight above, to 1e-5 rad


@dataclass(frozen=True)
class Light:
    """The light on a map, and the position that it is seen from.

    horizon : terrain horizon towards the Sun (None: nothing casts shadows)
    camera_position : (3,), body-fixed, m (None: straight above every pixel)
    earthshine, bounce : light besides the Sun's own
    """

    sun: Sun
    horizon: Horizon | None
    camera_position: NDArray[np.float64] | None
    extensions: Sequence[Extension] = ()
    earthshine: Earthshine | None = None
    bounce: Bounce | None = None


class ClipNegative:
    """Clips the I/F of lit facets at 0, as the first step of the chain's reflectance slot; ``below`` (B, H, W) says where.

    Fitted formulas, such as a polynomial's, fall below 0 near the terminator.
    """

    slot = "reflectance"

    def __init__(self) -> None:
        self.below: torch.Tensor | None = None

    def apply(self, state: State) -> None:
        """Clip the reflectance."""
        self.below = state.reflectance < 0
        state.reflectance = state.reflectance.clamp(min=0)


class AddRadiance:
    """Adds I/F (h, w) of further light to the chain's radiance."""

    slot = "illumination"

    def __init__(self, radiance: Floats32) -> None:
        self._radiance = torch.from_numpy(np.nan_to_num(radiance))[None]

    def apply(self, state: State) -> None:
        """Register the addition, which runs once the Sun's own light is known."""
        state.further_light.append(self._add)

    def _add(self, state: State) -> None:
        state.radiance = state.radiance + self._radiance


def shade_block(surface: Surface, light: Light, row: int, col: int, height: int, width: int) -> dict[str, Floats32]:
    """``image`` (I/F) and the backplanes of a window, each (height, width), NaN where the map is unknown.

    ``clipped`` is 1 where the model gave I/F below 0, which is drawn as 0.
    ``image_std``, where the map has errors, is the standard deviation of a photograph of the same view about the image.
    ``sky_view`` is there where terrain lights terrain.
    """
    window, grid = Window(row, col, height, width), surface.grid
    elevation = surface.read_padded(*window, 1)
    geometry = block_geometry(grid, row, col, elevation, light.sun.position, light.camera_position)
    visible = _visible(light.horizon, light.sun, geometry, window)
    around = window.padded(HALO_PX, (grid.height, grid.width)) if light.extensions else window
    added, sky = further_radiance(surface, light, around)
    if light.extensions:
        image, clipped = form_window(surface, light, window, added)
    else:
        image, clipped = _reflected(surface, geometry, visible, window)
        image = image if added is None else image + added
    planes = {"image": image, "clipped": clipped}
    if sky is not None:
        planes["sky_view"] = sky[window.within(around).part]
    shadow = _shadow(geometry, visible)
    if surface.knows_errors:
        planes["image_std"] = _deviation(surface, geometry, visible, window, image)
    return planes | {
        "incidence_deg": _degrees(geometry.angles.cos_incidence),
        "emission_deg": _degrees(geometry.angles.cos_emission),
        "phase_deg": _degrees(geometry.angles.cos_phase),
        "shadow": shadow,
        "depth": geometry.depth,
        "longitude_deg": geometry.longitude_deg,
        "latitude_deg": geometry.latitude_deg,
        "elevation": elevation[1:-1, 1:-1],
    }


def _visible(horizon: Horizon | None, source: Sun, geometry: BlockGeometry, window: Window) -> Floats32:
    """(h, w) share of the source's disc that stands above the terrain."""
    if horizon is None:
        return np.ones((window.height, window.width), np.float32)
    return visible_share(geometry.sun_elevation, horizon.window(*window), source.radius)


def _reflected(
    surface: Surface, geometry: BlockGeometry, visible: Floats32, window: Window
) -> tuple[Floats32, Floats32]:
    """(h, w) I/F of facets in a source's light, NaN where unknown, and 1 where the model's was below 0."""
    coefficients = torch.from_numpy(np.ascontiguousarray(surface.read_coefficients(*window)))
    parameters = surface.model.unpack(coefficients, dim=0)
    image = masked_radiance_factor(surface.model, parameters, geometry.angles).numpy()
    clipped = (image < 0).astype(np.float32)
    image = np.maximum(image, 0) * visible
    unknown = np.isnan(geometry.cos_incidence) | ~np.isfinite(coefficients.numpy()).all(axis=0)
    image[unknown] = np.nan
    clipped[unknown] = 0
    return image, clipped


def further_radiance(surface: Surface, light: Light, window: Window) -> tuple[Floats32 | None, Floats32 | None]:
    """I/F that the Earth and the terrain around add, and the sky view, (h, w) each; None without such light."""
    added = sky = None
    if light.earthshine is not None:
        earth, position = light.earthshine, light.camera_position
        heights = surface.read_padded(*window, 1)
        geometry = block_geometry(surface.grid, window.row, window.col, heights, earth.disc.position, position)
        visible = _visible(earth.horizon, earth.disc, geometry, window)
        added = np.float32(earth.irradiance) * _reflected(surface, geometry, visible, window)[0]
    if light.bounce is not None:
        scattered, sky = light.bounce.window(*window)
        added = scattered if added is None else added + scattered
    return added, sky


def image_deviation(surface: Surface, light: Light, window: Window, image: Floats32 | None = None) -> Floats32:
    """Standard deviation of a photograph about a rendering of a map that has errors, NaN where the map is unknown.

    image : (h, w) I/F of the window, where extensions have shaded it; returns (h, w), I/F
    """
    elevation = surface.read_padded(*window, 1)
    geometry = block_geometry(
        surface.grid, window.row, window.col, elevation, light.sun.position, light.camera_position
    )
    visible = _visible(light.horizon, light.sun, geometry, window)
    if image is None:
        image = _reflected(surface, geometry, visible, window)[0]
    return _deviation(surface, geometry, visible, window, image)


def _deviation(
    surface: Surface, geometry: BlockGeometry, visible: Floats32, window: Window, image: Floats32
) -> Floats32:
    """(h, w) I/F: errors of the albedo, or of the coefficients as the model passes them on, with those of the images."""
    if surface.albedo_error is not None:
        # the albedo was fitted to photographs, with these coefficients: its errors include theirs
        dark = _shadow(geometry, visible) > SHADOWED
        found, _ = surface.albedo_error.half_widths(
            window.row, window.col, image, geometry.cos_incidence, dark, np.clip(geometry.sun[2], 0.0, 1.0)
        )
        found[np.isnan(image)] = np.nan
        return found
    known = torch.from_numpy(np.ascontiguousarray(surface.read_coefficients(*window)))
    values = surface.model.unpack(known, dim=0)
    deviations = {k: torch.from_numpy(v) for k, v in surface.read_deviations(*window).items()}
    found = radiance_deviation(surface.model, values, deviations, geometry.angles).numpy() * visible
    found[np.isnan(geometry.cos_incidence) | ~np.isfinite(known.numpy()).all(axis=0)] = np.nan
    return np.hypot(found, np.float32(surface.image_noise))


def _shadow(geometry: BlockGeometry, visible: Floats32) -> Floats32:
    """(h, w) share of the Sun's disc that is hidden, by the facet itself or the terrain; NaN where the ground is unknown."""
    shadow = np.where(geometry.cos_incidence > 0, 1 - visible, np.float32(1))
    shadow[np.isnan(geometry.cos_incidence)] = np.nan
    return shadow


def form_window(
    surface: Surface, light: Light, window: Window, added: Floats32 | None = None
) -> tuple[Floats32, Floats32]:
    """I/F of a window through the formation chain with its extensions, tile by tile, and 1 where the model's was below 0.

    added : I/F that further light adds, on the window padded by HALO_PX
    returns (h, w) float32 each
    """
    shape = (surface.grid.height, surface.grid.width)
    around = window.padded(HALO_PX, shape)
    result = np.full((2, window.height, window.width), np.nan, np.float32)
    for r in range(0, window.height, TILE_PX):
        for c in range(0, window.width, TILE_PX):
            tile = Window(
                window.row + r, window.col + c, min(TILE_PX, window.height - r), min(TILE_PX, window.width - c)
            )
            wide = tile.padded(HALO_PX, shape)
            more = [] if added is None else [AddRadiance(added[wide.within(around).part])]
            formed = _form_tile(surface, light, wide, [*light.extensions, *more])
            result[:, *tile.within(window).part] = formed[:, *tile.within(wide).part]
    return result[0], result[1]


def _form_tile(surface: Surface, light: Light, tile: Window, extensions: Sequence[Extension]) -> Floats32:
    """(2, h, w): I/F, and 1 where the model's was clipped."""
    grid, (row, col, height, width) = surface.grid, tile
    elevation = surface.elevation[tile.part]
    coefficients = surface.read_coefficients(*tile)
    known = np.isfinite(elevation) & np.isfinite(coefficients).all(axis=0)
    if not known.any():
        return np.stack([np.full((height, width), np.nan, np.float32), np.zeros((height, width), np.float32)])
    level = float(elevation[np.isfinite(elevation)].mean())
    axes = grid.local_frames(row + (height - 1) / 2, col + (width - 1) / 2).axes[0]
    centre = axes[2] * (grid.radius + level)
    sun = axes @ light.sun.directions(centre)
    camera = (
        np.array([0.0, 0.0, STRAIGHT_ABOVE])
        if light.camera_position is None
        else axes @ (light.camera_position - centre)
    )
    horizon = None
    if light.horizon is not None:
        # nodata neither shades nor is shaded
        horizon = torch.from_numpy(np.nan_to_num(light.horizon.window(*tile), nan=-1.5))[None]
    observation = Observation(
        elevation=torch.from_numpy(np.where(np.isfinite(elevation), elevation, level).astype(np.float32))[None],
        sun_direction=torch.from_numpy(sun)[None],
        camera_position=torch.from_numpy(camera)[None],
        gsd=grid.gsd,
        body_radius=grid.radius,
        sun_horizon=horizon,
        frame=torch.full((1,), -1),
    )
    filled = torch.from_numpy(np.nan_to_num(coefficients).astype(np.float32))[None]
    clip = ClipNegative()
    with torch.no_grad():
        whole = filled.expand(1, -1, height, width)
        image = form(observation, surface.model, whole, [clip, *extensions])[0].numpy()
    assert clip.below is not None
    below = np.broadcast_to(clip.below[0].numpy(), image.shape)
    return np.stack([np.where(known, image, np.nan), below & known]).astype(np.float32)


def _degrees(cosine: torch.Tensor) -> Floats32:
    return np.degrees(np.arccos(np.clip(cosine.numpy(), -1.0, 1.0))).astype(np.float32)
