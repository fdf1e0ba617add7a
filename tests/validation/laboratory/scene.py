"""What a scene is made of, and the I/F of its ground before any camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from .camera import Camera, draw_camera
from .dem import DemErrors, draw_dem_errors, given_dem
from .fields import Array
from .geometry import SUN_RADIUS, PairGeometry, Sky, draw_sky, pair_geometry
from .ground import Ground, draw_ground
from .laws import Law, draw_law
from .layout import LAYOUTS, Needs, Sites, draw_sites
from .light import horizon_elevation, render


@dataclass
class Scene:
    sites: Sites
    ground: Ground
    errors: DemErrors
    law: Law
    sky: Sky
    camera: Camera
    pairs: list[tuple[int, int]]  # site, image
    seed: int  # of the noise
    margin: int  # px rendered around a crop
    geometry: PairGeometry
    dem: Array  # (grid, grid), m: as the file gives it
    datum: float  # m, mean height of all crops
    mean_iof: float = 0.0
    read_variance: float = 0.0  # of the noise: read_variance + photon_variance * I/F
    photon_variance: float = 0.0
    clean: dict[int, Array] = field(default_factory=dict)  # pair -> I/F on its fine window
    transfer: dict[tuple[int, float], Array] = field(default_factory=dict)  # image, further blur -> see `exposure`
    smooth_height: dict[int, Array] = field(default_factory=dict)  # site -> see `exposure`

    @property
    def size(self) -> int:
        return self.sites.size

    @property
    def story(self) -> str:
        return f"{self.ground.story}, {self.sky.story}"

    def window(self, site: int) -> tuple[int, int, int]:
        """First row, first column and size of a crop with its margin on the fine grid."""
        reach = self.size // 2 + self.margin
        fine = self.ground.fine
        row, col = (self.sites.row[site] - reach) * fine, (self.sites.col[site] - reach) * fine
        return row, col, 2 * reach * fine

    def cut(self, fine_grid: Array, site: int) -> Array:
        row, col, size = self.window(site)
        return fine_grid[row : row + size, col : col + size]

    def plain(self, pair: int) -> Array:
        """I/F of a pair's fine window with nothing planted (float32)."""
        if pair not in self.clean:
            self.clean[pair] = self.lit(pair)
        return self.clean[pair]

    def lit(
        self,
        pair: int,
        sun: Array | None = None,
        height: Array | None = None,
        radius_deg: float | None = None,
        departure: Array | None = None,
        ridge: Array | None = None,
        earth: Array | None = None,
    ) -> Array:
        """I/F of a pair's fine window with another Sun, ground, solar radius, law (see `laws.departed`) or light (see `light`)."""
        site, image = self.pairs[pair]
        row, col, size = self.window(site)
        fine = self.ground.fine
        centre = np.array(
            [self.sites.row[site] * fine - 0.5, self.sites.col[site] * fine - 0.5, self.geometry.height[pair]]
        )
        if radius_deg is None:
            radius_deg = SUN_RADIUS / self.sky.distance[image]
        out = np.zeros((size, size), np.float32)
        render(
            self.ground.height if height is None else height,
            self.ground.texture,
            row,
            col,
            self.ground.spacing,
            centre,
            self.geometry.sun[pair] if sun is None else sun,
            math.radians(radius_deg),
            self.geometry.camera[pair],
            self.law.code,
            self.law.parameters,
            np.zeros(6) if departure is None else departure,
            np.zeros(6) if ridge is None else ridge,
            np.zeros(4) if earth is None else earth,
            out,
        )
        return out

    def horizons(self, dem: Array, sun: Array) -> Array:
        """(pairs, size, size), degrees: elevation of a DEM's horizon in the azimuth of each pair's Sun (pairs, 3)."""
        half = self.size // 2
        out = np.zeros((len(self.pairs), self.size, self.size))
        for q, (site, _) in enumerate(self.pairs):
            horizontal = math.hypot(sun[q][0], sun[q][1])
            east, north = sun[q][0] / horizontal, sun[q][1] / horizontal
            row, col = self.sites.row[site] - half, self.sites.col[site] - half
            horizon_elevation(dem, row, col, self.ground.gsd, east, north, out[q])
        return out

    def height_seen(self, site: int) -> Array:
        """Heights of a fine window (m), smoothed by half a pixel: where a line of sight meets the ground."""
        if site not in self.smooth_height:
            cut = self.cut(self.ground.height, site).astype(float)
            self.smooth_height[site] = ndimage.gaussian_filter(cut, 0.5 * self.ground.fine)
        return self.smooth_height[site]

    def noise_deviation(self, iof: Array) -> Array:
        """Standard deviation of a detector pixel's noise at I/F `iof`."""
        return np.sqrt(self.read_variance + self.photon_variance * np.maximum(iof, 0))


def draw_scene(rng: np.random.Generator, layout: str, needs: Needs, given_law: bool = False) -> Scene:
    """Everything of a case but what is planted."""
    chosen = LAYOUTS[layout]
    fine = 3 if (chosen.size == 128 or not chosen.shared) else int(rng.choice([3, 4, 4, 5]))
    gsd = float(rng.choice([1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 40.0]))
    images = chosen.images or int(rng.integers(4, 7))
    sites = draw_sites(rng, layout, images)
    ground = draw_ground(rng, needs, gsd, sites.grid, fine)
    errors = draw_dem_errors(rng, sites.grid, gsd)
    law = draw_law(rng, needs, given_law)
    sky = draw_sky(rng, needs, images, sites.grid * gsd)
    camera = draw_camera(rng, needs, gsd, sites.grid, sky.emission, sky.view_azimuth)
    scene = Scene(
        sites=sites,
        ground=ground,
        errors=errors,
        law=law,
        sky=sky,
        camera=camera,
        pairs=sites.pairs(),
        seed=int(rng.integers(2**62)),
        margin=needs.margin,
        geometry=pair_geometry(sites, ground, sky, camera),
        dem=given_dem(ground, errors),
        datum=float(sites.crops(ground.pixels).mean()),
    )
    # the signal-to-noise ratio holds at the mean signal of some pairs
    some = range(0, len(scene.pairs), max(1, len(scene.pairs) // 8))
    scene.mean_iof = float(np.mean([scene.plain(pair).mean() for pair in some]))
    variance = (scene.mean_iof / camera.snr) ** 2
    scene.read_variance = variance * camera.read_share
    scene.photon_variance = variance * (1 - camera.read_share) / scene.mean_iof
    return scene
