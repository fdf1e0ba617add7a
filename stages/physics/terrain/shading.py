"""Shading a map on its own grid, block by block: I/F and backplanes of any window, in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from stages.physics.formation.chain import Extension, Observation, State, form
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import masked_radiance_factor
from stages.physics.photometry.deviation import radiance_deviation
from stages.physics.terrain.ground import BlockGeometry, block_geometry
from stages.physics.terrain.sun import Sun
from stages.physics.terrain.sun_visibility import SunHorizon, visible_share
from stages.physics.terrain.surface import SHADOWED, Surface

Floats32 = NDArray[np.float32]
BACKPLANES = (
    "incidence_deg",
    "emission_deg",
    "phase_deg",
    "shadow",
    "depth",
    "longitude_deg",
    "latitude_deg",
)
TILE_PX = 128  # extensions were found on crops about this large, with a tangent plane each
HALO_PX = 16
STRAIGHT_ABOVE = 1e8  # m: from here every pixel of a tile is seen from straight above, to 1e-5 rad


@dataclass(frozen=True)
class Light:
    """Sun, its horizon over the map (None: nothing casts shadows) and the camera (None: straight above every pixel)."""

    sun: Sun
    horizon: SunHorizon | None
    camera_position: NDArray[np.float64] | None
    extensions: Sequence[Extension] = ()


class Floor:
    """Formulas that are fitted, such as a polynomial's, fall below 0 near the terminator; no ground does.

    Clips the I/F of lit facets at 0, as the first step of the chain's reflectance; ``below`` (B, H, W) says where.
    """

    slot = "reflectance"

    def __init__(self) -> None:
        self.below: torch.Tensor | None = None

    def apply(self, state: State) -> None:
        self.below = state.reflectance < 0
        state.reflectance = state.reflectance.clamp(min=0)


def shade_block(surface: Surface, light: Light, row: int, col: int, height: int, width: int) -> dict[str, Floats32]:
    """``image`` (I/F) and the backplanes of a window, each (height, width), NaN where the map is unknown.

    ``clipped`` is 1 where the model gave I/F below 0, which is drawn as 0.
    ``image_std`` is among them where the map knows its errors: of a photograph of the same view, pixel by pixel.
    """
    elevation = read_padded(surface, row, col, height, width, 1)
    geometry = block_geometry(surface.grid, row, col, elevation, light.sun.position, light.camera_position)
    visible = np.ones((height, width), np.float32)
    if light.horizon is not None:
        sun_elevation = np.arcsin(np.clip(geometry.sun[2], -1.0, 1.0))
        visible = visible_share(sun_elevation, light.horizon.window(row, col, height, width), light.sun.radius)
    if light.extensions:
        image, clipped = form_window(surface, light, row, col, height, width)
    else:
        coefficients = torch.from_numpy(np.ascontiguousarray(surface.read_coefficients(row, col, height, width)))
        parameters = surface.model.unpack(coefficients, dim=0)
        cosines = (geometry.cos_incidence, geometry.cos_emission, geometry.cos_phase)
        angles = Angles(*(torch.from_numpy(v) for v in cosines))
        image = masked_radiance_factor(surface.model, parameters, angles).numpy()
        clipped = (image < 0).astype(np.float32)
        image = np.maximum(image, 0) * visible
        unknown = np.isnan(geometry.cos_incidence) | ~np.isfinite(coefficients.numpy()).all(axis=0)
        image[unknown] = np.nan
        clipped[unknown] = 0
    shadow = np.where(geometry.cos_incidence > 0, 1 - visible, np.float32(1))
    shadow[np.isnan(geometry.cos_incidence)] = np.nan
    deviation = {}
    if surface.albedo_error is not None:
        # photographs have corrected the coefficients' errors: those of the albedo stand in their place
        inner, _ = surface.albedo_error.half_widths(
            row, col, image, geometry.cos_incidence, shadow > SHADOWED, np.clip(geometry.sun[2], 0.0, 1.0)
        )
        inner[np.isnan(image)] = np.nan
        deviation = {"image_std": inner}
    elif surface.deviations is not None:
        deviation = _image_deviation(surface, geometry, visible, row, col)
    return {
        "image": image,
        "clipped": clipped,
        **deviation,
        "incidence_deg": _degrees(geometry.cos_incidence),
        "emission_deg": _degrees(geometry.cos_emission),
        "phase_deg": _degrees(geometry.cos_phase),
        "shadow": shadow,
        "depth": geometry.depth,
        "longitude_deg": geometry.longitude_deg,
        "latitude_deg": geometry.latitude_deg,
        "elevation": elevation[1:-1, 1:-1],
    }


def _image_deviation(
    surface: Surface, geometry: BlockGeometry, visible: Floats32, row: int, col: int
) -> dict[str, Floats32]:
    """``image_std``, (h, w) I/F: errors of the coefficients, through the model, and the images' own."""
    height, width = visible.shape
    known = torch.from_numpy(np.ascontiguousarray(surface.read_coefficients(row, col, height, width)))
    values = surface.model.unpack(known, dim=0)
    deviations = {k: torch.from_numpy(v) for k, v in surface.read_deviations(row, col, height, width).items()}
    angles = Angles(*(torch.from_numpy(v) for v in (geometry.cos_incidence, geometry.cos_emission, geometry.cos_phase)))
    found = radiance_deviation(surface.model, values, deviations, angles).numpy() * visible
    found[np.isnan(geometry.cos_incidence) | ~np.isfinite(known.numpy()).all(axis=0)] = np.nan
    return {"image_std": np.hypot(found, np.float32(surface.image_noise))}


def read_padded(surface: Surface, row: int, col: int, height: int, width: int, margin: int) -> Floats32:
    """(height + 2 margin, width + 2 margin) elevations, NaN outside the map."""
    result = np.full((height + 2 * margin, width + 2 * margin), np.nan, np.float32)
    top, left = max(0, row - margin), max(0, col - margin)
    bottom = min(surface.grid.height, row + height + margin)
    right = min(surface.grid.width, col + width + margin)
    result[top - row + margin : bottom - row + margin, left - col + margin : right - col + margin] = surface.elevation[
        top:bottom, left:right
    ]
    return result


def form_window(
    surface: Surface, light: Light, row: int, col: int, height: int, width: int
) -> tuple[Floats32, Floats32]:
    """I/F of a window through the whole formation chain with its extensions, tile by tile with a margin; where it was clipped."""
    result = np.full((2, height, width), np.nan, np.float32)
    for r in range(0, height, TILE_PX):
        for c in range(0, width, TILE_PX):
            h, w = min(TILE_PX, height - r), min(TILE_PX, width - c)
            top, left = max(0, row + r - HALO_PX), max(0, col + c - HALO_PX)
            bottom = min(surface.grid.height, row + r + h + HALO_PX)
            right = min(surface.grid.width, col + c + w + HALO_PX)
            tile = _form_tile(surface, light, top, left, bottom - top, right - left)
            inner = tile[:, row + r - top : row + r - top + h, col + c - left : col + c - left + w]
            result[:, r : r + h, c : c + w] = inner
    return result[0], result[1]


def _form_tile(surface: Surface, light: Light, row: int, col: int, height: int, width: int) -> Floats32:
    """(2, height, width): I/F, and 1 where the model's was clipped."""
    grid = surface.grid
    elevation = surface.elevation[row : row + height, col : col + width]
    coefficients = surface.read_coefficients(row, col, height, width)
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
        horizon = torch.from_numpy(np.nan_to_num(light.horizon.window(row, col, height, width), nan=-1.5))[None]
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
    floor = Floor()
    with torch.no_grad():
        whole = filled.expand(1, -1, height, width)
        image = form(observation, surface.model, whole, [floor, *light.extensions])[0].numpy()
    assert floor.below is not None
    below = np.broadcast_to(floor.below[0].numpy(), image.shape)
    return np.stack([np.where(known, image, np.nan), below & known]).astype(np.float32)


def _degrees(cosine: Floats32) -> Floats32:
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).astype(np.float32)
