"""The effects that can be hidden: how one strength sets their parameters, and how strong they must be.

Names, units and signs are those of the catalogue of the judged program; floors are twice what it says
that any data may have.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .randomness import generator, log_uniform, sign
from .world import World

Values = dict[str, float]


@dataclass(frozen=True)
class Effect:
    """Parameters from a strength, its least, first and greatest value, and the measure that sets it.

    measure: "fid", "rms_of_pair_gains" or "fid_abs_all_pixels".
    """

    values: Callable[[float, World, int], Values]
    lowest: float
    first: float
    highest: float
    measure: str = "fid"
    floor: float = 0.0


def one(parameter: str, signed: bool = False) -> Callable[[float, World, int], Values]:
    """The strength is the parameter itself, with a random sign if signed."""

    def values(strength: float, world: World, seed: int) -> Values:
        return {parameter: strength * (sign(generator(seed, "sign")) if signed else 1.0)}

    return values


def relief_share(strength: float, world: World, seed: int) -> Values:
    """Share of the parallax left in (sometimes taken out twice), and the rms displacement over the data."""
    share = strength if generator(seed, "sign").uniform() < 0.85 else -strength
    return {"share": share, "rms_px": strength * unit_displacement(world)}


def unit_displacement(world: World) -> float:
    """Rms of h tan(emission) over the data, map pixels."""
    heights, size = [], world.size
    for site in world.sites:
        part = world.scenes[site.scene].relief[
            site.top * world.fine : (site.top + size) * world.fine,
            site.left * world.fine : (site.left + size) * world.fine,
        ]
        heights.append((float(part.mean()), float(np.mean(part**2))))
    mean = np.mean([heights[s][0] for s, _ in world.pairs])
    total = 0.0
    for number, frame in world.pairs:
        camera, site = world.frames[frame].camera, world.sites[number]
        away = np.hypot(camera.row - site.top - size / 2, camera.col - site.left - size / 2) / camera.height
        square = heights[number][1] - 2 * mean * heights[number][0] + mean**2
        total += square * away**2
    return float(np.sqrt(total / len(world.pairs)))


def ridge(strength: float, world: World, seed: int) -> Values:
    """A ridge beyond the side of the DEM that faces the lowest Sun; strength: its height in map pixels."""
    used = [world.frames[f] for _, f in world.pairs]
    lowest = min(used, key=lambda frame: frame.sun_elevation_deg)
    side = round(lowest.sun_azimuth_deg / 90) % 4 * 90
    return {"height_m": strength * world.gsd_m, "side_deg": float(side)}


def earthlight(strength: float, world: World, seed: int) -> Values:
    """A source of random direction."""
    rng = generator(seed, "source")
    return {
        "irradiance": strength,
        "elevation_deg": float(rng.uniform(25, 80)),
        "azimuth_deg": float(rng.uniform(0, 360)),
    }


def anisotropy(strength: float, world: World, seed: int) -> Values:
    """A random direction; painted on (shading 0) or relief below a pixel (shading 1)."""
    rng = generator(seed, "direction")
    bearing = rng.uniform(0, 2 * np.pi)
    return {
        "east": strength * float(np.sin(bearing)),
        "north": strength * float(np.cos(bearing)),
        "shading": float(rng.integers(2)),
    }


def surge(strength: float, world: World, seed: int) -> Values:
    """A surge of random width."""
    return {"B0": strength, "h": log_uniform(generator(seed, "width"), 0.03, 0.2)}


def echo(strength: float, world: World, seed: int) -> Values:
    """An echo along samples (axis 1) or lines (axis 0), before or after."""
    rng = generator(seed, "lag")
    fraction = strength * (1.0 if rng.uniform() < 0.8 else -1.0)
    lag = float(rng.integers(2, 13)) * sign(rng)
    return {"fraction": fraction, "lag_px": lag, "axis": float(rng.integers(2))}


def bend(strength: float, world: World, seed: int) -> Values:
    """A quadratic or a logarithmic bend; strength: relative change at a usual brightness of 0.05."""
    rng = generator(seed, "bend")
    size = strength * sign(rng)
    if rng.uniform() < 0.5:
        return {"quadratic": size / 0.05, "log": 0.0}
    return {"quadratic": 0.0, "log": size / 3}


def full_well(strength: float, world: World, seed: int) -> Values:
    """A level; strength: how far below an I/F that few pixels reach, as a logarithm."""
    brightest = max(world.scenes[site.scene].albedo.mean() * site.albedo for site in world.sites)
    return {"iof": float(2.5 * brightest * np.exp(-strength))}


GAINS, SHADOWS = "rms_of_pair_gains", "fid_abs_all_pixels"

EFFECTS = {
    "dem_scale": Effect(one("relative", True), 0.04, 0.06, 0.45, floor=0.04),
    "dem_smoothing": Effect(one("sigma2_px2"), 1.4, 1.6, 4.0, floor=1.4),
    "line_jitter": Effect(one("rms_px"), 0.3, 0.5, 6.0, floor=0.3),
    "misregistration": Effect(one("rms_px"), 0.84, 1.0, 6.0, floor=0.84),
    "relief_displacement": Effect(relief_share, 0.02, 0.4, 1.5, floor=0.2),  # the floor is of rms_px
    "distant_shadow": Effect(ridge, 3.0, 30.0, 200.0, SHADOWS),
    "earthshine": Effect(earthlight, 2e-4, 5e-4, 0.02, SHADOWS, floor=2e-4),
    "interreflection": Effect(one("strength"), 0.6, 1.0, 8.0, SHADOWS, floor=0.6),
    "penumbra": Effect(one("radius_deg"), 0.35, 1.0, 3.8, SHADOWS),
    "sun_azimuth": Effect(one("error_deg", True), 0.03, 1.0, 40.0),
    "sun_elevation": Effect(one("error_deg", True), 0.02, 0.5, 8.0),
    "albedo_map": Effect(one("per_std"), 0.06, 0.06, 0.3, SHADOWS, floor=0.06),
    "azimuthal_anisotropy": Effect(anisotropy, 0.01, 0.06, 0.29, GAINS),
    "curvature_albedo": Effect(one("per_std", True), 0.02, 0.03, 0.2, SHADOWS, floor=0.02),
    "elevation_albedo": Effect(one("per_std", True), 0.02, 0.03, 0.2, SHADOWS, floor=0.02),
    "slope_albedo": Effect(one("per_std", True), 0.02, 0.03, 0.2, SHADOWS, floor=0.02),
    "limb_darkening": Effect(one("share", True), 0.02, 0.2, 0.95),
    "macroscopic_roughness": Effect(one("theta_bar_deg"), 8.0, 12.0, 40.0, floor=8.0),
    "opposition_surge": Effect(surge, 0.05, 0.8, 3.9, GAINS),
    "phase_slope": Effect(one("per_radian", True), 0.02, 0.2, 2.5, GAINS),
    "image_gain": Effect(one("rms"), 0.02, 0.04, 0.2, GAINS, floor=0.02),
    "column_pattern": Effect(one("rms"), 0.002, 0.004, 0.2, floor=0.002),
    "dark_bias": Effect(one("iof", True), 2e-4, 5e-4, 0.02, SHADOWS, floor=2e-4),
    "echo": Effect(echo, 0.006, 0.02, 0.4, floor=0.006),
    "frame_field": Effect(one("rms"), 0.02, 0.03, 0.3, floor=0.02),
    "nonlinearity": Effect(bend, 0.002, 0.05, 0.45),
    "psf_blur": Effect(one("sigma2_px2"), 1.2, 1.5, 6.0, floor=1.2),
    "saturation": Effect(full_well, 0.05, 0.6, 1.6),
}
