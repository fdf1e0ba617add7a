"""The light that reaches the camera from every DEM pixel of a window: the formation chain on the truth's fine grid."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import erf

from stages.common.arrays import Floats32
from stages.physics.formation import chain as formation
from stages.physics.horizon import horizon
from stages.physics.light.sun_disc import SUN_RADIUS, sun_visibility
from stages.physics.maps.grid import Grid
from stages.physics.photometry import masked_radiance_factor
from stages.simulate.hidden import Hidden
from stages.simulate.orbits import Pass
from stages.simulate.reflectance import Truth

BLOCK = 256  # DEM pixels; the Sun's and the camera's directions are exact at each block's centre
SHADOW_REACH = 20e3  # m; terrain farther off casts no shadow here
WHOLE = 20_000_000  # pixels of a scene whose horizon is swept at once


@dataclass
class Scene:
    """The truth on the DEM's grid: arrays (H, W) float32, in memory or mapped from disk."""

    grid: Grid
    elevation: NDArray
    log_geometry: NDArray
    log_free: NDArray
    truth: Truth


@dataclass
class View:
    """One image's Sun and camera, body-fixed, m."""

    shot: Pass
    sun_position: NDArray[np.float64]
    camera_position: NDArray[np.float64]


def radiance(scene: Scene, view: View, window: tuple[int, int, int, int], wanted: NDArray, hidden: Hidden) -> Floats32:
    """I/F (H, W) of the window (row, col, height, width), 0 in shadow; blocks without a ``wanted`` pixel stay 0.

    wanted : (H, W) bool
    """
    row, col, height, width = window
    out = np.zeros((height, width), np.float32)
    axes = scene.grid.local_frames(row + height / 2, col + width / 2).axes[0]
    to_sun = axes @ view.sun_position
    azimuth = math.atan2(to_sun[0], to_sun[1])
    elevation_angle = math.atan2(to_sun[2], math.hypot(to_sun[0], to_sun[1]))
    skyline = _horizon(scene, window, azimuth, elevation_angle)
    penumbra = hidden.get("penumbra")
    sun_radius = math.radians(penumbra["radius_deg"]) if penumbra else SUN_RADIUS
    blocks = [
        (r, c, min(BLOCK, height - r), min(BLOCK, width - c))
        for r in range(0, height, BLOCK)
        for c in range(0, width, BLOCK)
    ]

    def fill(block: tuple[int, int, int, int]) -> None:
        r, c, h, w = block
        if wanted[r : r + h, c : c + w].any():
            part = skyline[r : r + h, c : c + w]
            out[r : r + h, c : c + w] = _block(scene, view, row + r, col + c, part, sun_radius, hidden)

    # a block a thread: blocks fit the cache, and threads do not wait for each other at every operation
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(fill, blocks))
    finally:
        torch.set_num_threads(threads)
    return out


def _horizon(scene: Scene, window: tuple[int, int, int, int], azimuth: float, sun_elevation: float) -> Floats32:
    """Elevation of the terrain's horizon over a window, from the whole scene or as far as shadows reach."""
    row, col, height, width = window
    total_height, total_width = scene.elevation.shape
    r0, c0, r1, c1 = 0, 0, total_height, total_width
    if total_height * total_width > WHOLE:
        part = scene.elevation[::16, ::16]
        reach = min(float(part.max() - part.min()) / max(math.tan(sun_elevation), 0.02), SHADOW_REACH)
        reach_px = math.ceil(reach / scene.grid.gsd) + 8
        r0, c0 = max(0, row - reach_px), max(0, col - reach_px)
        r1, c1 = min(total_height, row + height + reach_px), min(total_width, col + width + reach_px)
    # about a middle height: float32 then resolves the small differences that near horizons are made of
    part = np.asarray(scene.elevation[r0:r1, c0:c1])
    skyline = horizon(part - np.float32(part[::16, ::16].mean()), scene.grid.gsd, azimuth, scene.grid.radius)
    return skyline[row - r0 : row - r0 + height, col - c0 : col - c0 + width]


def _block(
    scene: Scene, view: View, row: int, col: int, skyline: Floats32, sun_radius: float, hidden: Hidden
) -> Floats32:
    """The chain on one block; one pixel around it keeps slopes central."""
    height, width = skyline.shape
    total_height, total_width = scene.elevation.shape
    top, left = min(1, row), min(1, col)
    bottom, right = min(1, total_height - row - height), min(1, total_width - col - width)
    elevation = np.asarray(scene.elevation[row - top : row + height + bottom, col - left : col + width + right])
    padded = np.pad(elevation, ((1 - top, 1 - bottom), (1 - left, 1 - right)), mode="reflect", reflect_type="odd")

    frame = scene.grid.local_frames(row + (height - 1) / 2, col + (width - 1) / 2)
    axes, up = frame.axes[0], frame.up[0]
    place = up * (scene.grid.radius + float(padded.mean()))
    sun = axes @ (view.sun_position - place)
    camera = axes @ (view.camera_position - place)
    observation = formation.Observation(
        elevation=torch.from_numpy(padded)[None],
        sun_direction=torch.from_numpy(sun / np.linalg.norm(sun))[None],
        camera_position=torch.from_numpy(camera)[None],
        gsd=scene.grid.gsd,
        body_radius=scene.grid.radius,
    )
    state = formation.illuminate(observation)
    sun_elevation = math.asin(float(observation.sun_direction[0, 2]))
    visible = sun_visibility(
        torch.tensor(sun_elevation), torch.from_numpy(np.pad(skyline, 1, mode="edge"))[None], sun_radius
    )
    window = (slice(row, row + height), slice(col, col + width))
    maps = scene.truth.maps(np.asarray(scene.log_geometry[window]), np.asarray(scene.log_free[window]))
    parameters = {name: torch.tensor(value, dtype=torch.float32) for name, value in scene.truth.constants.items()}
    for name, values in maps.items():
        parameters[name] = torch.from_numpy(np.pad(values, 1, mode="edge"))[None]
    lit = masked_radiance_factor(scene.truth.model, parameters, state.angles)
    surge, slope = hidden.get("opposition_surge"), hidden.get("phase_slope")
    if surge:
        tangent = torch.tan(state.angles.phase / 2)
        lit = lit * (1 + surge["B0"] / (1 + tangent / surge["h"]))
    if slope:
        lit = lit * torch.exp(-slope["per_radian"] * state.angles.phase)
    result = lit * visible
    shine = hidden.get("earthshine")
    if shine:
        result = result + _earthshine(state, shine)
    return result[0, 1:-1, 1:-1].numpy()


def _earthshine(state: formation.State, shine: dict[str, float]) -> torch.Tensor:
    """Lambertian light of a second, weak source without shadows."""
    elevation, azimuth = math.radians(shine["elevation_deg"]), math.radians(shine["azimuth_deg"])
    east, north = math.cos(elevation) * math.sin(azimuth), math.cos(elevation) * math.cos(azimuth)
    slope_east, slope_north = state.slopes
    facing = math.sin(elevation) - slope_east * east - slope_north * north
    return shine["irradiance"] * facing.clamp(min=0) / torch.sqrt(1 + slope_east**2 + slope_north**2)


def point_spread(step: float, image_gsd: float, sigma_px: float, extra_sigma2_px2: float = 0.0) -> Floats32:
    """Separable kernel on the DEM grid: the image pixel's area (a box) and the optics (a Gaussian), 1 in sum."""
    sigma = math.sqrt(sigma_px**2 + extra_sigma2_px2) * image_gsd / step
    half = 0.5 * image_gsd / step
    reach = max(1, math.ceil(half + 4 * sigma))
    x = np.arange(-reach, reach + 1)
    fine = (np.arange(64) + 0.5) / 64 - 0.5  # each tap is the mean over a DEM pixel
    t = x[:, None] + fine
    if sigma > 1e-6:
        kernel = 0.5 * (erf((t + half) / (sigma * math.sqrt(2))) - erf((t - half) / (sigma * math.sqrt(2))))
    else:
        kernel = (np.abs(t) <= half).astype(float)
    taps = kernel.mean(1)
    return (taps / taps.sum()).astype(np.float32)


def blur(image: Floats32, kernel: Floats32) -> Floats32:
    """image : (H, W); kernel : (n,), applied along rows and columns; edges repeated."""
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)
