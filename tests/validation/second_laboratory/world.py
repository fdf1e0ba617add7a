"""A world: scenes of ground, the images taken of them, and the crops that the file holds."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, laplace

from . import relief as ground_relief
from .camera import Camera
from .hidden import Hidden
from .laws import Law, draw_law
from .light import Window
from .randomness import correlated_field, generator, log_uniform, sign

LAYOUTS = {"4x12": (4, 12), "6x8": (6, 8), "12x4": (12, 4), "40x1": (40, 8)}  # sites, images per scene
MARGIN = 56  # map pixels of DEM around the crops
LOW_SUN = {"distant_shadow", "earthshine", "interreflection", "penumbra"}  # seen in shadows only


@dataclass(frozen=True)
class Frame:
    """One image: its Sun as given (deg), camera, and the errors of its own."""

    scene: int
    sun_azimuth_deg: float
    sun_elevation_deg: float
    camera: Camera
    gain_error: float
    registration_px: tuple[float, float]
    signal_to_noise: float
    broad_rms: float
    broad_px: float


@dataclass(frozen=True)
class Site:
    """A crop of a scene: its first row and column (map pixels), and how its soil differs."""

    scene: int
    top: int
    left: int
    split: int
    albedo: float
    twist: float


@dataclass(frozen=True)
class Scene:
    """Ground of one DEM: heights (map pixels, fine grid), albedo and change of the law's parameters."""

    relief: np.ndarray
    albedo: np.ndarray
    twist: np.ndarray
    height_errors: np.ndarray
    traits: dict[str, np.ndarray]


@dataclass(frozen=True)
class World:
    """All that is the same with and without what a case hides; variances in px2 of the map."""

    seed: int
    layout: str
    size: int
    fine: int
    gsd_m: float
    law: Law
    scenes: list[Scene]
    frames: list[Frame]
    sites: list[Site]
    pairs: list[tuple[int, int]]
    dem_variance: float
    dem_scale_error: float
    optics_variance: float
    cubic: bool
    flat_rms: float
    scattered: float
    latitude_deg: float
    text: str

    def window(self, site: Site, pad: int, fine: int) -> Window:
        """The site's rectangle with a border of pad map pixels, on a grid fine times finer than the map."""
        size = (self.size + 2 * pad) * fine
        return Window((site.top - pad) * fine, (site.left - pad) * fine, size, size)

    def ordinary_blur(self) -> float:
        """Variance of the whole imaging beyond a map pixel's own, px2."""
        pixel = float(np.mean([frame.camera.pixel_px**2 for frame in self.frames]))
        return self.optics_variance * pixel + pixel / 12 - 1 / 12 + (0.02 if self.cubic else pixel / 6)

    def given_dem(self, scene: int, hidden: Hidden) -> np.ndarray:
        """The DEM that the file gives, heights in map pixels."""
        variance = hidden.get("dem_smoothing", "sigma2_px2", self.dem_variance)
        ground = self.scenes[scene]
        scale = 0.0 if hidden.name == "dem_scale" else self.dem_scale_error
        return ground_relief.measured_dem(ground.relief, self.fine, variance, scale, ground.height_errors)


def draw_sun(rng: np.random.Generator, latitude_deg: float, low: bool) -> tuple[float, float]:
    """Azimuth and elevation (deg) of the Sun at a time of the lunar day that puts it at a usual height."""
    latitude, declination = np.radians(latitude_deg), np.radians(rng.uniform(-1.5, 1.5))
    wanted = rng.uniform(6, 14) if low else rng.uniform(15, 60)
    highest = 90 - abs(latitude_deg) - 3
    wanted = np.radians(min(wanted, rng.uniform(0.75, 1.0) * highest))
    cosine = (np.sin(wanted) - np.sin(latitude) * np.sin(declination)) / (np.cos(latitude) * np.cos(declination))
    hour = float(np.arccos(np.clip(cosine, -1, 1))) * sign(rng)
    east = -np.cos(declination) * np.sin(hour)
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(hour)
    return float(np.degrees(np.arctan2(east, north)) % 360), float(np.degrees(wanted))


def draw_frame(
    rng: np.random.Generator,
    scene: int,
    shape: tuple[int, int],
    gsd_m: float,
    latitude_deg: float,
    style: dict,
    low: bool,
) -> Frame:
    """One image of a scene; style: share of low Suns, whether views are oblique and detectors turned."""
    azimuth, elevation = draw_sun(rng, latitude_deg, low or rng.uniform() < style["low"])
    tilt = rng.uniform(10, 25) if style["oblique"] else min(abs(rng.normal(0, 10)), 25)
    turn = rng.uniform(0, 360) if style["turned"] else rng.normal(0, 2) + 180 * rng.integers(2)
    camera = Camera.over_scene(
        shape,
        height_px=rng.uniform(40e3, 120e3) / gsd_m,
        tilt_deg=float(tilt),
        azimuth_deg=rng.uniform(0, 360),
        turn_deg=float(turn),
        pixel_px=float(rng.uniform(0.8, 1.05) if style["turned"] else style["pixel"] * rng.uniform(0.97, 1.03)),
        first_px=(rng.uniform(0, 300), rng.uniform(0, 400)),
    )
    error = rng.uniform(0.05, 0.25)
    bearing = rng.uniform(0, 2 * np.pi)
    return Frame(
        scene, azimuth, elevation, camera,
        gain_error=float(np.clip(rng.normal(0, style["gain"]), -0.02, 0.02)),
        registration_px=(float(error * np.sin(bearing)), float(error * np.cos(bearing))),
        signal_to_noise=log_uniform(rng, 60, 200),
        broad_rms=rng.uniform(0.003, 0.008),
        broad_px=log_uniform(rng, 5, 30),
    )  # fmt: skip


def smooth_pattern(rng: np.random.Generator, shape: tuple[int, int], size: int) -> np.ndarray:
    """A field of rms 1 that bends within a crop of `size`."""
    field = correlated_field(rng, shape, size * rng.uniform(0.3, 0.5))
    return field / field.std()


def make_scene(rng: np.random.Generator, shape: tuple[int, int], fine: int, size: int) -> tuple[Scene, str]:
    """Ground of one scene (shape in map pixels)."""
    heights, text = ground_relief.make_relief(rng, shape, fine)
    cells = heights.shape
    heights -= heights[MARGIN * fine : -MARGIN * fine, MARGIN * fine : -MARGIN * fine].mean()
    grain = correlated_field(rng, cells, rng.uniform(0.7, 3.0) * fine)
    broad = np.repeat(np.repeat(smooth_pattern(rng, shape, size), fine, 0), fine, 1)
    albedo = rng.uniform(0.03, 0.09) * (1 + rng.uniform(0.01, 0.05) * grain) * (1 + rng.uniform(0.012, 0.03) * broad)
    twist = rng.uniform(0.01, 0.03) * np.repeat(np.repeat(smooth_pattern(rng, shape, size), fine, 0), fine, 1)
    dem = ground_relief.block_mean(heights, fine)
    traits = {
        "slope_albedo": np.hypot(*np.gradient(dem)),
        "curvature_albedo": laplace(gaussian_filter(dem, 2.0)),
        "elevation_albedo": gaussian_filter(dem, 7 / np.pi),
    }
    scene = Scene(
        heights, albedo.astype(np.float32), twist.astype(np.float32), ground_relief.height_errors(rng, shape), traits
    )
    return scene, text


def standardised(scenes: list[Scene], sites: list[Site], size: int) -> list[Scene]:
    """Scenes whose traits have mean 0 and standard deviation 1 over all crops of the data."""
    result = [replace(scene, traits={}) for scene in scenes]
    for name in scenes[0].traits:
        crops = [scenes[s.scene].traits[name][s.top : s.top + size, s.left : s.left + size] for s in sites]
        mean, spread = np.mean(crops), np.std(crops)
        for scene, new in zip(scenes, result, strict=True):
            new.traits[name] = ((scene.traits[name] - mean) / spread).astype(np.float32)
    return result


def draw_sites(rng: np.random.Generator, count: int, per_scene: int, size: int) -> tuple[list[Site], tuple[int, int]]:
    """Sites in a loose grid in each scene, about 15 % each for validation and test; and the scenes' shape."""
    across = int(np.ceil(np.sqrt(per_scene)))
    down = int(np.ceil(per_scene / across))
    gap = int(rng.integers(4, 20))
    held_out = max(1, round(0.15 * count))
    split = rng.permutation([2] * held_out + [1] * held_out + [0] * (count - 2 * held_out))
    sites = []
    for number in range(count):
        row, col = divmod(number % per_scene, across)
        top, left = (MARGIN + k * (size + gap) + int(rng.integers(gap)) for k in (row, col))
        soil = (float(1 + 0.1 * rng.standard_normal()), float(0.03 * rng.standard_normal()))
        sites.append(Site(number // per_scene, top, left, int(split[number]), *soil))
    return sites, (2 * MARGIN + down * (size + gap), 2 * MARGIN + across * (size + gap))


def make_world(seed: int, layout: str, effect: str | None, given_law: bool = False) -> World:
    """Draw a world; the effect only decides whether low Suns or oblique views, without which it cannot show."""
    rng = generator(seed, "world")
    count, images = LAYOUTS[layout]
    size = 128 if rng.uniform() < 0.3 else 96
    fine = 3 if size == 96 and layout != "40x1" and rng.uniform() < 0.3 else 2
    scene_count = int(rng.choice({"4x12": [1, 2], "6x8": [1, 2], "12x4": [1, 2, 3], "40x1": [1]}[layout]))
    per_scene = count // scene_count
    images = int(rng.integers(6, 11)) if layout == "40x1" else images
    sites, shape = draw_sites(rng, count, per_scene, size)
    gsd_m, latitude = log_uniform(rng, 1.0, 10.0), sign(rng) * rng.uniform(15, 55)
    low = rng.uniform(0.0, 0.2)
    style = {
        "low": max(low, 0.35) if effect in LOW_SUN else low,
        "oblique": effect == "relief_displacement" or rng.uniform() < 0.15,
        "turned": layout in ("4x12", "12x4"),
        "pixel": rng.uniform(0.8, 1.05),
        "gain": rng.uniform(0.004, 0.009),
    }
    made = [make_scene(generator(seed, "scene", k), shape, fine, size) for k in range(scene_count)]
    frames = [
        draw_frame(rng, scene, shape, gsd_m, latitude, style, low=effect in LOW_SUN and k % 4 == 0)
        for scene in range(scene_count)
        for k in range(images)
    ]
    if layout == "40x1":
        pairs = [(site, int(rng.integers(images))) for site in range(count)]
    else:
        pairs = [(s, sites[s].scene * images + k) for s in range(count) for k in range(images)]
    text = f"{scene_count} scene(s) at {gsd_m:.1f} m, latitude {latitude:.0f} deg, crops of {size} px; {made[0][1]}"
    scenes = standardised([scene for scene, _ in made], sites, size)
    return World(
        seed, layout, size, fine, gsd_m, draw_law(rng, given_law), scenes, frames, sites, pairs,
        dem_variance=rng.uniform(0.2, 0.6), dem_scale_error=rng.uniform(-0.012, 0.012),
        optics_variance=rng.uniform(0.1, 0.3), cubic=bool(rng.uniform() < 0.5), flat_rms=rng.uniform(0.001, 0.003),
        scattered=rng.uniform(0.05, 0.25), latitude_deg=float(latitude), text=text,
    )  # fmt: skip
