"""From radiance on the ground to a digital image: resampling, the detector's response, noise, footprints, gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import rasterio.warp
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.transform import Affine

from stages.common.arrays import Floats, Floats32
from stages.physics.detector import Exposure, Sensor
from stages.physics.detector import readout as detector_model
from stages.physics.maps.grid import Grid
from stages.simulate.hidden import Hidden
from stages.simulate.orbits import Pass, Strip
from stages.simulate.recipe import Config


@dataclass(frozen=True)
class Detector:
    """What one image's detector does to the signal, all drawn once per image.

    gain, offset : DN = gain x I/F + offset; 1 and 0 for calibrated images
    shift : (east, north) m by which the image lies from where its georeference says; jitter : amplitude, m, and phases
    response : gain error of the image; electrons : per I/F
    model, exposure : of a sensor that the recipe names, whose gain and offset these are
    """

    gain: float
    offset: float
    shift: tuple[float, float]
    jitter: tuple[float, float, float]
    response: float
    column_phases: Floats
    electrons: float
    model: Sensor | None = None
    exposure: Exposure | None = None

    @property
    def top(self) -> int:
        """The largest DN."""
        return 4095 if self.model is None else self.model.top


def make_detector(config: Config, shot: Pass, hidden: Hidden, mean_iof: float, rng: np.random.Generator) -> Detector:
    """Draw the detector of one image; mean_iof : I/F of level ground, which auto-exposure aims at."""
    shift_rms, jitter, response = config.registration_error, 0.0, 1.0
    if effect := hidden.get("misregistration"):
        shift_rms = math.hypot(shift_rms, effect["rms_px"] * shot.gsd / math.sqrt(2))
    if effect := hidden.get("line_jitter"):
        jitter = effect["rms_px"] * shot.gsd * math.sqrt(2)
    if effect := hidden.get("image_gain"):
        response = 1 + effect["rms"] * float(rng.normal())
    gain, offset = 1.0, 0.0
    if config.units == "dn":  # 12 bits, auto-exposed, with a pedestal
        gain, offset = 900.0 / max(mean_iof, 1e-3) * float(rng.uniform(0.8, 1.25)), float(rng.uniform(40, 120))
    electrons = config.full_well / (2 * max(mean_iof, 1e-3))
    model, exposure = config.sensor_model(), None
    if model is not None:
        exposure = model.expose(2 * mean_iof, shot.sun.distance_au)
        electrons = exposure.electrons
        gain, offset = electrons / model.electrons_per_dn, model.offset_dn
    shift = rng.normal(0, 1, 2) * shift_rms
    return Detector(
        gain,
        offset,
        (float(shift[0]), float(shift[1])),
        (jitter, float(rng.uniform(0, 2 * math.pi)), float(rng.uniform(0.6, 1.6))),
        response,
        rng.uniform(0, 2 * math.pi, 3),
        electrons,
        model,
        exposure,
    )


def image_grid(config: Config, scene: Grid, shot: Pass, number: int) -> Grid:
    """The image's own map grid: another projection, resolution and extent than the DEM's, whole pixels of its own."""
    radius = scene.radius
    if number % 3 == 2:
        projection = f"+proj=sinu +lon_0={config.longitude_deg - 0.4:.4f}"
    else:
        projection = f"+proj=eqc +lat_ts={config.latitude_deg:.4f} +lat_0=0 +lon_0={round(config.longitude_deg)}"
    crs = CRS.from_proj4(f"{projection} +x_0=0 +y_0=0 +R={radius!r} +units=m +no_defs")
    x, y = _outline(shot.strip, scene.bounds())
    u, v = (np.asarray(a) for a in rasterio.warp.transform(scene.crs, crs, x, y))
    g = shot.gsd
    left, top = math.floor(u.min() / g) * g, math.ceil(v.max() / g) * g
    width, height = math.ceil((u.max() - left) / g), math.ceil((top - v.min()) / g)
    return Grid(crs.to_wkt(), Affine(g, 0, left, 0, -g, top), height, width, radius)


def _outline(strip: Strip, bounds: tuple[float, float, float, float]) -> tuple[Floats, Floats]:
    """Points along the edge of what the strip and the scene share, map metres."""
    left, bottom, right, top = bounds
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(left, right, 129), np.linspace(bottom, top, 129)))
    along, across = strip.along_across(x, y)
    inside = (np.abs(along) < strip.length / 2 * 1.03) & (np.abs(across) < strip.width / 2 * 1.05)
    return (x[inside], y[inside]) if inside.any() else (x, y)


@dataclass
class Lattice:
    """Where each pixel of a band of an image lies on the DEM's grid, by a cubic through exact points.

    row, col : (H, W) float64, DEM pixels; x, y : map metres from the scene's centre
    """

    row: Floats
    col: Floats
    x: Floats
    y: Floats

    @classmethod
    def fit(cls, image: Grid, first: int, height: int, scene: Grid) -> Lattice:
        """The lattice of ``height`` lines of an image from line ``first`` on, by a cubic fit to the projection."""
        rows = np.linspace(first, first + height - 1, 9)
        cols = np.linspace(0, image.width - 1, 9)
        rr, cc = np.meshgrid(rows, cols, indexing="ij")
        x, y = image.xy(rr, cc)
        tx, ty = rasterio.warp.transform(image.crs, scene.crs, x.ravel(), y.ravel())
        s = _scaled(rr.ravel(), first, height)
        t = _scaled(cc.ravel(), 0, image.width)
        powers = [(i, j) for i in range(4) for j in range(4 - i)]
        design = np.stack([s**i * t**j for i, j in powers], axis=1)
        solution, *_ = np.linalg.lstsq(design, np.stack([tx, ty], axis=1), rcond=None)
        si = _scaled(np.arange(first, first + height), first, height)[:, None]
        ti = _scaled(np.arange(image.width), 0, image.width)[None]
        gx, gy = (_cubic(dict(zip(powers, values, strict=True)), si, ti) for values in solution.T)
        row, col = scene.rowcol(gx, gy)
        return cls(row, col, gx, gy)


def _cubic(factors: dict[tuple[int, int], float], s: Floats, t: Floats) -> Floats:
    """Sum of factors[i, j] s^i t^j, s : (H, 1), t : (1, W); a few passes over (H, W) instead of one for each factor."""
    total = np.zeros((s.size, t.size))
    for j in (3, 2, 1, 0):
        total *= t
        total += sum(factors[i, j] * s**i for i in range(4 - j))
    return total


def _scaled(values: NDArray, first: float, count: int) -> Floats:
    return (np.asarray(values, float) - first) / max(count - 1, 1) * 2 - 1


def footprint(config: Config, shot: Pass, x: Floats, y: Floats, number: int) -> NDArray[np.bool_]:
    """Where the image has data: a strip with ragged edges, lost lines and holes, inside the scene.

    x, y : (H, W), m from the scene's centre
    """
    strip, half = shot.strip, config.extent / 2
    along, across = strip.along_across(x, y)
    rng = np.random.default_rng([config.seed, 5, number])
    phases = rng.uniform(0, 2 * math.pi, 4)
    drift = (
        0.006
        * strip.width
        * (
            np.sin(along / (0.11 * config.extent) + phases[0])
            + 0.6 * np.sin(along / (0.031 * config.extent) + phases[1])
        )
    )
    inside = np.abs(across + drift) < strip.width / 2
    # the first and last line are cut at a slant, as a map projection of a turning camera leaves them
    slant = float(rng.uniform(-0.12, 0.12))
    inside &= np.abs(along + slant * across) < strip.length / 2
    inside &= (np.abs(x) < half - 2 * config.dem_gsd) & (np.abs(y) < half - 2 * config.dem_gsd)
    for _ in range(config.image_holes):
        ca, cu = rng.uniform(-0.45, 0.45) * strip.length, rng.uniform(-0.5, 0.5) * strip.width
        if rng.random() < 0.5:  # lost lines
            inside &= ~((np.abs(along - ca) < rng.uniform(1.5, 5) * shot.gsd) & (across > cu))
        else:  # a patch that the calibration rejected
            a, b = rng.uniform(0.008, 0.02, 2) * config.extent
            inside &= ((along - ca) / a) ** 2 + ((across - cu) / b) ** 2 > 1
    return inside


def resample(radiance: Floats32, row: Floats, col: Floats, window: tuple[int, int, int, int]) -> Floats32:
    """Cubic interpolation of a window of the blurred radiance at DEM pixel coordinates.

    radiance : (h, w) I/F of the window (row, col, height, width); row, col : (H, W) px; returns (H, W)
    """
    u, v = (col - window[1]).astype(np.float32), (row - window[0]).astype(np.float32)
    return np.asarray(cv2.remap(radiance, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32)


def move(config: Config, shot: Pass, detector: Detector, lattice: Lattice, step: float) -> tuple[Floats, Floats]:
    """Where the camera really looked, in DEM pixels: the georeference's place plus planted shift and jitter."""
    east, north = detector.shift
    row, col = lattice.row - north / step, lattice.col + east / step
    amplitude, phase, waves = detector.jitter
    if amplitude:
        along, _ = shot.strip.along_across(lattice.x, lattice.y)
        drift = amplitude / step * np.sin(2 * math.pi * waves * along / shot.strip.length + phase)
        heading = math.radians(shot.strip.heading_deg)
        row, col = row + drift * math.sin(heading), col + drift * math.cos(heading)
    return row, col


def respond(
    image: Floats32,
    echo: Floats32 | None,
    lattice: Lattice,
    shot: Pass,
    detector: Detector,
    hidden: Hidden,
) -> Floats32:
    """The hidden detector effects, in the order of the hardware: echo, dark signal, columns, gain, response, clipping.

    image, echo : (H, W), I/F
    """
    if (effect := hidden.get("echo")) and echo is not None:
        image = image + np.float32(effect["fraction"]) * echo
    if effect := hidden.get("dark_bias"):
        image = image + np.float32(effect["iof"])
    if effect := hidden.get("column_pattern"):
        _, across = shot.strip.along_across(lattice.x, lattice.y)
        t = across / shot.strip.width
        a, b, c = detector.column_phases
        pattern = np.cos(2 * math.pi * t + a) + 0.7 * np.cos(4 * math.pi * t + b) + 0.5 * np.cos(8 * math.pi * t + c)
        image = image * (1 + effect["rms"] * pattern / math.sqrt(0.5 * (1 + 0.49 + 0.25))).astype(np.float32)
    image = image * np.float32(detector.response)
    if effect := hidden.get("nonlinearity"):
        image = image * (1 + np.float32(effect["quadratic"]) * image)
    if effect := hidden.get("saturation"):
        image = np.minimum(image, np.float32(effect["iof"]))
    return image


def read_out(
    image: Floats32, config: Config, shot: Pass, detector: Detector, lattice: Lattice, rng: np.random.Generator
) -> Floats32:
    """The image with noise, by the recipe's sensor or by shot and read noise alone.

    image : (H, W), I/F; a sensor's columns lie across the strip, its other patterns on the image's own pixels
    """
    if detector.model is not None and detector.exposure is not None:
        _, across = shot.strip.along_across(lattice.x, lattice.y)
        x = np.clip(2 * across / shot.strip.width, -1, 1)
        counts = detector_model.read_out(detector.model, image, detector.exposure, x, np.zeros((1, 1)), rng)
        return ((counts - detector.offset) / detector.gain).astype(np.float32)
    electrons = np.float32(detector.electrons)
    return image + detector_model.noise_electrons(image * electrons, config.read_noise, rng) / electrons
