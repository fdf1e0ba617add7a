"""Radiance (I/F) of the ground in one image, on the fine grid around a crop."""

from dataclasses import dataclass

import numpy as np

from .hidden import Hidden
from .light import SUN_RADIUS_DEG, Window, direction, horizon_tangent, normals, scattered_light, visible_disc
from .randomness import generator, stretch
from .relief import block_mean
from .roughness import roughness_factor
from .world import Frame, Site, World

PAD = 24  # map pixels of ground around a crop
STANDARD_COSINE = np.cos(np.radians(30.0))


@dataclass(frozen=True)
class Geometry:
    """Angles and light at each cell: heights (map pixels), normals, cosines, phase (radian), visible Sun."""

    relief: np.ndarray
    normal: tuple[np.ndarray, np.ndarray, np.ndarray]
    mu0: np.ndarray
    mu: np.ndarray
    phase: np.ndarray
    sunlight: np.ndarray


def ridge_tangent(world: World, hidden: Hidden, window: Window, relief: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Tangent of the elevation of a ridge beyond a side of the DEM, with a crest that is not quite level."""
    rng = generator(hidden.seed, "ridge")
    beyond, phases = rng.uniform(4, 30), rng.uniform(0, 2 * np.pi, 3)
    side_deg = hidden.values["side_deg"]
    fine, shape = world.fine, world.scenes[0].relief.shape
    row = (window.top + np.arange(window.rows, dtype=np.float32)[:, None]) / fine
    col = (window.left + np.arange(window.cols, dtype=np.float32)[None, :]) / fine
    across = {0: row, 90: shape[1] / fine - col, 180: shape[0] / fine - row, 270: col}[int(side_deg)] + beyond
    along = col if side_deg in (0, 180) else row
    turn = np.radians(azimuth_deg - side_deg)
    if np.cos(turn) < 0.05:
        return np.full(relief.shape, -1.0, np.float32)
    hit = along + across * np.tan(turn) * (1 if side_deg in (0, 90) else -1)
    crest = 1 + sum(0.03 * np.sin(2 * np.pi * hit / (35 * (k + 1)) + phases[k]) for k in range(3))
    height = hidden.values["height_m"] / world.gsd_m
    return ((height * crest - relief) * np.cos(turn) / across).astype(np.float32)


def true_sun(frame: Frame, hidden: Hidden) -> tuple[float, float]:
    """Azimuth and elevation (deg) of the Sun that really shone."""
    return (
        frame.sun_azimuth_deg + hidden.get("sun_azimuth", "error_deg", 0.0),
        max(frame.sun_elevation_deg + hidden.get("sun_elevation", "error_deg", 0.0), 1.0),
    )


def make_geometry(world: World, relief: np.ndarray, site: Site, frame: Frame, hidden: Hidden) -> Geometry:
    """Angles and sunlight for one pair; relief is the scene's true one."""
    window = world.window(site, PAD, world.fine)
    cell = 1 / world.fine
    part = relief[window.top : window.top + window.rows, window.left : window.left + window.cols]
    east, north, up = normals(part, cell)
    azimuth, elevation = true_sun(frame, hidden)
    sun = direction(azimuth, elevation)
    offset = (world.fine - 1) / 2  # a map pixel's centre is the centre of its block of cells
    row = ((window.top + np.arange(window.rows)[:, None] - offset) * cell).astype(np.float32)
    col = ((window.left + np.arange(window.cols)[None, :] - offset) * cell).astype(np.float32)
    view = frame.camera.direction_from(row, col, part)
    radius = hidden.get("penumbra", "radius_deg", SUN_RADIUS_DEG)
    lowest = float(np.tan(np.radians(max(elevation - radius, 0.8))))
    horizon = horizon_tangent(relief, window, cell, azimuth, lowest)
    if hidden.name == "distant_shadow":
        horizon = np.maximum(horizon, ridge_tangent(world, hidden, window, part, azimuth))
    mu0 = np.maximum(east * sun[0] + north * sun[1] + up * sun[2], 0)
    mu = np.clip(east * view[0] + north * view[1] + up * view[2], 0.02, 1)
    phase = np.arccos(np.clip(view[0] * sun[0] + view[1] * sun[1] + view[2] * sun[2], -1, 1))
    return Geometry(part, (east, north, up), mu0, mu, phase, visible_disc(elevation, horizon, radius))


def albedo_pattern(world: World, site: Site, number: int, hidden: Hidden) -> np.ndarray:
    """Relative albedo that an effect of the ground adds, on the fine window of a site."""
    shape = world.window(site, PAD, world.fine)[2:]
    if hidden.name == "albedo_map":
        rng = generator(hidden.seed, "albedo map", number)
        place = (np.arange(shape[0]) / world.fine - PAD) / world.size
        waves = np.cos(np.pi * np.arange(4)[:, None] * place[None, :])
        weight = rng.standard_normal((4, 4)) / (1 + np.add.outer(np.arange(4), np.arange(4)))
        weight[0, 0] = 0
        field = waves.T @ weight @ waves
        edge = PAD * world.fine
        return hidden.values["per_std"] * field / field[edge:-edge, edge:-edge].std()
    trait = world.scenes[site.scene].traits.get(hidden.name or "")
    if trait is None:
        return np.zeros(shape, np.float32)
    window = world.window(site, PAD, 1)
    part = trait[window.top : window.top + window.rows, window.left : window.left + window.cols]
    return hidden.values["per_std"] * np.clip(stretch(part, world.fine, shape), -6, 6)


def law_change(world: World, frame: Frame, at: Geometry, hidden: Hidden) -> np.ndarray | float:
    """Factor on the law's reflectance that an effect of reflectance brings."""
    v = hidden.values
    if hidden.name == "limb_darkening":
        return np.maximum(1 - v["share"] + v["share"] * 2 / (at.mu0 + at.mu), 0.02)
    if hidden.name == "macroscopic_roughness":
        return roughness_factor(at.mu0, at.mu, at.phase, v["theta_bar_deg"])
    if hidden.name == "opposition_surge":
        return 1 + v["B0"] / (1 + np.tan(at.phase / 2) / v["h"])
    if hidden.name == "phase_slope":
        return np.exp(-v["per_radian"] * at.phase)
    if hidden.name == "azimuthal_anisotropy":
        used = [world.frames[f].sun_elevation_deg for _, f in world.pairs]
        lowness = 1 / np.tan(np.radians(frame.sun_elevation_deg)) / np.mean(1 / np.tan(np.radians(used)))
        azimuth = np.radians(frame.sun_azimuth_deg)
        return 1 + (v["east"] * np.sin(azimuth) + v["north"] * np.cos(azimuth)) * lowness ** v["shading"]
    return 1.0


def radiance(world: World, number: int, frame: Frame, at: Geometry, hidden: Hidden) -> np.ndarray:
    """I/F of every cell of the window of site `number`."""
    site = world.sites[number]
    window = world.window(site, PAD, world.fine)
    cut = np.s_[window.top : window.top + window.rows, window.left : window.left + window.cols]
    scene = world.scenes[site.scene]
    albedo = scene.albedo[cut] * site.albedo * np.maximum(1 + albedo_pattern(world, site, number, hidden), 0.1)
    law = world.law.reflectance(at.mu0, at.mu, at.phase, scene.twist[cut] + site.twist)
    result = albedo * law * at.sunlight * law_change(world, frame, at, hidden)
    # Scattered light is smooth: cells of two map pixels do.
    coarse = 2 * world.fine
    diffuse = block_mean(albedo * at.mu0 * at.sunlight, coarse) / STANDARD_COSINE
    strength = hidden.get("interreflection", "strength", world.scattered)
    lit = strength * scattered_light(block_mean(at.relief, coarse), 2.0, diffuse)
    result = result + stretch(lit, coarse, albedo.shape) * albedo / STANDARD_COSINE
    irradiance = hidden.get("earthshine", "irradiance", 2e-5)
    source = direction(hidden.get("earthshine", "azimuth_deg", 0.0), hidden.get("earthshine", "elevation_deg", 60.0))
    facing = np.maximum(sum(n * s for n, s in zip(at.normal, source, strict=True)), 0)
    return (result + irradiance * facing * albedo / albedo.mean()).astype(np.float32)
