"""Images of a world on its map, with and without what a case hides."""

import numpy as np

from . import camera as optics
from .camera import Chip
from .ground import PAD, Geometry, make_geometry, radiance
from .hidden import GEOMETRY, GROUND, NOTHING, OPTICS, Hidden
from .randomness import generator
from .relief import block_mean, smooth_relief
from .sensor import read_out
from .world import World


class Simulator:
    """Makes the images of a world; keeps what does not change when something else is hidden."""

    def __init__(self, world: World) -> None:
        self.world = world
        self._geometries: dict[int, Geometry] = {}
        self._points: dict[int, tuple[Chip, tuple[np.ndarray, np.ndarray]]] = {}
        self._signals: dict[int, np.ndarray] = {}
        self._relief: tuple[object, list[np.ndarray]] = (None, [])
        self._dems: tuple[object, list[np.ndarray]] = (None, [])

    def relief(self, hidden: Hidden) -> list[np.ndarray]:
        """True heights of each scene.

        For dem_smoothing this is the ground as the DEM has it: the difference to the true ground is the effect.
        """
        grounds = [scene.relief for scene in self.world.scenes]
        if hidden.name not in ("dem_scale", "dem_smoothing"):
            return grounds
        key = (hidden.name, tuple(hidden.values.items()))
        if self._relief[0] != key:
            if hidden.name == "dem_scale":
                changed = [ground * np.float32(1 + hidden.values["relative"]) for ground in grounds]
            else:
                extra = hidden.values["sigma2_px2"] - self.world.dem_variance
                changed = [smooth_relief(ground, self.world.fine, extra) for ground in grounds]
            self._relief = (key, changed)
        return self._relief[1]

    def given_dems(self, hidden: Hidden) -> list[np.ndarray]:
        """The DEM of each scene as the file gives it, heights in map pixels."""
        key = (hidden.name, tuple(hidden.values.items())) if hidden.name in ("dem_scale", "dem_smoothing") else "usual"
        if self._dems[0] != key:
            self._dems = (key, [self.world.given_dem(k, hidden) for k in range(len(self.world.scenes))])
        return self._dems[1]

    def geometry(self, pair: int, hidden: Hidden) -> Geometry:
        """Angles and light of a pair."""
        number, frame = self.world.pairs[pair]
        site = self.world.sites[number]
        if hidden.name in GEOMETRY:
            relief = self.relief(hidden)[site.scene]
            return make_geometry(self.world, relief, site, self.world.frames[frame], hidden)
        if pair not in self._geometries:
            relief = self.world.scenes[site.scene].relief
            self._geometries[pair] = make_geometry(self.world, relief, site, self.world.frames[frame], NOTHING)
        return self._geometries[pair]

    def view(self, pair: int, relief: np.ndarray | None) -> tuple[Chip, tuple[np.ndarray, np.ndarray]]:
        """The chip of a pair and the ground it sees; relief: the window's heights if they are not the usual ones."""
        if relief is None and pair in self._points:
            return self._points[pair]
        number, frame = self.world.pairs[pair]
        site, camera = self.world.sites[number], self.world.frames[frame].camera
        heights = self.geometry(pair, NOTHING).relief
        edge = PAD * self.world.fine
        level = float(heights[edge:-edge, edge:-edge].mean())
        corner = np.array([0, 0, self.world.size - 1, self.world.size - 1], float)
        plane = camera.on_plane(site.top + corner, site.left + corner[[0, 2, 0, 2]], np.full(4, level))
        chip = Chip.around(*camera.to_detector(*plane))
        offset = (self.world.fine - 1) / 2 / self.world.fine
        start = (site.top - PAD - offset, site.left - PAD - offset)
        used = heights if relief is None else relief
        points = optics.seen_points(camera, chip, used, *start, self.world.fine)
        if relief is None:
            self._points[pair] = (chip, points)
        return chip, points

    def signal(self, pair: int, hidden: Hidden) -> tuple[Chip, np.ndarray]:
        """Light on each detector pixel (I/F), before the detector does anything to it."""
        touched = hidden.name in GROUND or hidden.name in OPTICS
        number, frame = self.world.pairs[pair]
        if not touched and pair in self._signals:
            return self.view(pair, None)[0], self._signals[pair]
        at = self.geometry(pair, hidden)
        other_relief = at.relief if hidden.name in ("dem_scale", "dem_smoothing") else None
        chip, points = self.view(pair, other_relief)
        ground = radiance(self.world, number, self.world.frames[frame], at, hidden)
        pixel = self.world.frames[frame].camera.pixel_px
        extra = hidden.get("psf_blur", "sigma2_px2", self.world.ordinary_blur()) - self.world.ordinary_blur()
        image = optics.expose(ground, points, self.world.optics_variance + max(extra, 0.0) / pixel**2)
        if not touched:
            self._signals[pair] = image
        return chip, image

    def crop_dem(self, pair: int, hidden: Hidden) -> np.ndarray:
        """The given DEM of a pair's crop, map pixels."""
        site = self.world.sites[self.world.pairs[pair][0]]
        size = self.world.size
        return self.given_dems(hidden)[site.scene][site.top : site.top + size, site.left : site.left + size]

    def coordinates(self, pair: int, hidden: Hidden) -> tuple[np.ndarray, np.ndarray]:
        """Line and sample that each map pixel is taken from, before errors of registration."""
        number, frame = self.world.pairs[pair]
        site, camera = self.world.sites[number], self.world.frames[frame].camera
        row, col = np.mgrid[: self.world.size, : self.world.size].astype(float)
        row, col = row + site.top, col + site.left
        on_plane = camera.on_plane(row, col, self.crop_dem(pair, hidden))
        done = 1 - hidden.get("relief_displacement", "share", 0.0)  # the share of the parallax that is taken out
        return camera.to_detector(row + done * (on_plane[0] - row), col + done * (on_plane[1] - col))

    def shifts(self, pair: int, line: np.ndarray, hidden: Hidden) -> tuple[np.ndarray | float, np.ndarray | float]:
        """Errors of registration of a pair in lines and samples."""
        frame = self.world.pairs[pair][1]
        shift = np.array(self.world.frames[frame].registration_px)
        if hidden.name == "misregistration":
            draws = generator(hidden.seed, "misregistration").standard_normal((len(self.world.frames), 2))
            used = draws[[f for _, f in self.world.pairs]]
            shift = hidden.values["rms_px"] * draws[frame] / np.sqrt(np.mean(np.sum(used**2, 1)))
        jitter = [np.zeros(1), np.zeros(1)]
        if hidden.name == "line_jitter":
            jitter = jitter_of(hidden, frame, line, self.world.size)
        pixel = self.world.frames[frame].camera.pixel_px
        return (shift[0] + jitter[0]) / pixel, (shift[1] + jitter[1]) / pixel

    def map_image(self, pair: int, hidden: Hidden, noisy: bool) -> np.ndarray:
        """The orthorectified image of a pair, I/F.

        With dem_smoothing and no noise this is the image that the smooth DEM would give; with noise it is the real one.
        """
        shining = NOTHING if hidden.name == "dem_smoothing" and noisy else hidden
        chip, signal = self.signal(pair, shining)
        image = read_out(signal, self.world, pair, (chip.line, chip.sample), hidden, noisy)
        line, sample = self.coordinates(pair, hidden)
        off_line, off_sample = self.shifts(pair, line, hidden)
        line, sample = line + off_line, sample + off_sample
        if hidden.name == "nearest_resampling":
            line, sample = np.round(line), np.round(sample)
        return optics.lay_on_map(image, chip, line, sample, self.world.cubic)

    def lit(self, pair: int) -> np.ndarray:
        """Map pixels of a crop that the whole Sun reaches."""
        at = self.geometry(pair, NOTHING)
        edge = PAD * self.world.fine
        lit = ((at.sunlight > 0.99) & (at.mu0 > 0.03))[edge:-edge, edge:-edge]
        return block_mean(lit.astype(float), self.world.fine) > 0.99


def jitter_of(hidden: Hidden, frame: int, line: np.ndarray, size: int) -> list[np.ndarray]:
    """Shifts (rows, columns; map pixels) of each line of an image: drift and tremble of periods 12 lines and more."""
    rng = generator(hidden.seed, "jitter", frame)
    result = []
    for _ in range(2):
        periods = np.exp(rng.uniform(np.log(12), np.log(1.5 * size), 6))
        weights = rng.standard_normal(6) * np.sqrt(periods)
        weights *= hidden.values["rms_px"] / np.sqrt(np.sum(weights**2))  # both axes together have the rms
        phases = rng.uniform(0, 2 * np.pi, 6)
        result.append(
            sum(w * np.cos(2 * np.pi * line / p + f) for w, p, f in zip(weights, periods, phases, strict=True))
        )
    return result
