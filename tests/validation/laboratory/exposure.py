"""From I/F on the fine grid to the detector and on to the map: blur, oblique view, sensor, noise, resampling."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from .camera import PSF_HALF, PSF_SAMPLES
from .fields import Array, standardised
from .resampling import resample
from .scene import Scene


@dataclass
class Patch:
    """The part of the detector that saw a crop: sample and line of each of its pixels, its image, and numbers for a fault."""

    samples: Array  # (lines, samples)
    lines: Array
    image: int
    rng: np.random.Generator


Change = Callable[[Array, Patch], Array]  # detector pixels -> detector pixels


@dataclass
class Departure:
    """What a plant changes between ground and map; left alone, nothing."""

    blur_px2: float = 0.0  # variance of a further Gaussian, map px2
    motion: float = 0.0  # detector px of smear along the lines' direction
    projection_height: Array | None = None  # (size, size), m: DEM of the map projection
    relief_share: float = 0.0  # of the relief that the map projection left out
    shift: Array | None = None  # (images, 2), px east and north, in place of the camera's
    jitter: list[Array] | None = None  # per image (2, lines), map px along and across the lines' direction
    optics: Change | None = None
    echo: tuple[float, int, str] | None = None  # fraction, lag in detector px, "sample" or "line"
    dark: float = 0.0  # I/F
    nonlinearity: tuple[float, float] | None = None  # I + a I^2 + b I ln I
    gain: Array | None = None  # (images,)
    columns: Array | None = None  # (width,)
    sensor: Change | None = None
    saturation: float = 0.0  # I/F
    after: Change | None = None
    resampling: int | None = None


def expose(
    scene: Scene, pair: int, iof: Array, departure: Departure | None = None, noise: bool = True
) -> tuple[Array, Array, Array]:
    """Map image (size, size) of a fine window's I/F, and the detector sample and line that each of its pixels was taken from."""
    departure = departure or Departure()
    image = scene.pairs[pair][1]
    noise_seed, broad_seed, fault_seed = np.random.default_rng([scene.seed, pair]).integers(2**62, size=3)
    blurred = _blurred(scene, image, iof, departure)
    sample, line = _projected(scene, pair, departure)
    pad = 4
    first, last = int(math.floor(sample.min())) - pad, int(math.ceil(sample.max())) + pad
    top, bottom = int(math.floor(line.min())) - pad, int(math.ceil(line.max())) + pad
    grid = np.meshgrid(np.arange(first, last + 1), np.arange(top, bottom + 1))
    patch = Patch(*grid, image, np.random.default_rng(fault_seed))
    rows, cols = _seen(scene, pair, patch, departure)
    detector = ndimage.map_coordinates(blurred, [rows, cols], order=3, mode="nearest")
    detector = _sensed(scene, detector, patch, departure, broad_seed)
    if noise:
        white = np.random.default_rng(noise_seed).standard_normal(detector.shape)
        detector = detector + scene.noise_deviation(detector) * white
    if departure.saturation:
        detector = np.minimum(detector, departure.saturation)
    if departure.after:
        detector = departure.after(detector, patch)
    mode = scene.camera.resampling if departure.resampling is None else departure.resampling
    return resample(np.ascontiguousarray(detector), line - top, sample - first, mode), sample, line


def _blurred(scene: Scene, image: int, iof: Array, departure: Departure) -> Array:
    size = iof.shape[0]
    transfer = _transfer(scene, image, size, departure.blur_px2)
    if departure.motion:
        east, north = np.linalg.inv(scene.camera.affine[image]) @ np.array([0, 1.0])  # m per line
        ky = fft.fftfreq(size)[:, None] / scene.ground.spacing
        kx = fft.rfftfreq(size)[None] / scene.ground.spacing
        transfer = transfer * np.sinc((kx * east - ky * north) * departure.motion)
    return fft.irfft2(fft.rfft2(iof.astype(np.float64)) * transfer, s=(size, size))


def _transfer(scene: Scene, image: int, size: int, blur_px2: float) -> Array:
    """Transfer function on a fine window of the camera's PSF, as the image's pose lays it on the ground, and a further Gaussian."""
    key = (image, round(blur_px2, 6))
    if key in scene.transfer:
        return scene.transfer[key]
    fine = scene.ground.fine
    half = int(10 * fine)
    u = np.arange(-half, half + 1) * scene.ground.spacing
    east, north = np.meshgrid(u, -u)
    a = scene.camera.affine[image]
    sample = a[0, 0] * east + a[0, 1] * north
    line = a[1, 0] * east + a[1, 1] * north
    at = [line * PSF_SAMPLES + PSF_HALF, sample * PSF_SAMPLES + PSF_HALF]
    kernel = ndimage.map_coordinates(scene.camera.psf, at, order=1, cval=0.0)
    kernel /= kernel.sum()
    padded = np.zeros((size, size))
    padded[: 2 * half + 1, : 2 * half + 1] = kernel
    transfer = fft.rfft2(np.roll(padded, (-half, -half), (0, 1)))
    if blur_px2 > 0:
        ky = fft.fftfreq(size)[:, None] * fine
        kx = fft.rfftfreq(size)[None] * fine
        transfer = transfer * np.exp(-2 * math.pi**2 * blur_px2 * (ky * ky + kx * kx))
    scene.transfer[key] = transfer
    return transfer


def _tangent(scene: Scene, pair: int) -> Array:
    """(2,): tangent of emission, towards the camera: a point h above the datum stands at its place - h t in the plane."""
    camera = scene.geometry.camera[pair]
    return camera[:2] / camera[2]


def _projected(scene: Scene, pair: int, departure: Departure) -> tuple[Array, Array]:
    """(size, size) each: where the map projection looks for a map pixel on the detector."""
    site, image = scene.pairs[pair]
    n, gsd = scene.size, scene.ground.gsd
    i, j = np.mgrid[:n, :n]
    centre = scene.geometry.centre[pair]
    east = centre[0] + (j - n / 2 + 0.5) * gsd
    north = centre[1] - (i - n / 2 + 0.5) * gsd
    height = departure.projection_height
    if height is None:
        height = scene.sites.crop(scene.dem, site)
    if departure.relief_share:
        height = height - departure.relief_share * (height - scene.datum)
    shift = (scene.camera.shift if departure.shift is None else departure.shift)[image] * gsd
    t = _tangent(scene, pair)
    east = east - (height - scene.ground.datum) * t[0] + shift[0]
    north = north - (height - scene.ground.datum) * t[1] + shift[1]
    a, offset = scene.camera.affine[image], scene.camera.offset[image]
    return a[0, 0] * east + a[0, 1] * north + offset[0], a[1, 0] * east + a[1, 1] * north + offset[1]


def _seen(scene: Scene, pair: int, patch: Patch, departure: Departure) -> tuple[Array, Array]:
    """Row and column of the fine window where each detector pixel's line of sight meets the true ground."""
    site, image = scene.pairs[pair]
    n, gsd, fine = scene.size, scene.ground.gsd, scene.ground.fine
    inverse = np.linalg.inv(scene.camera.affine[image])
    sample = patch.samples - scene.camera.offset[image, 0]
    line = patch.lines - scene.camera.offset[image, 1]
    plane_e = inverse[0, 0] * sample + inverse[0, 1] * line
    plane_n = inverse[1, 0] * sample + inverse[1, 1] * line
    if departure.jitter is not None:
        jitter = departure.jitter[image]
        at = np.clip(patch.lines, 0, jitter.shape[1] - 1)
        across = inverse @ np.array([1.0, 0])
        across /= np.linalg.norm(across)
        along = inverse @ np.array([0, 1.0])
        along /= np.linalg.norm(along)
        by_along, by_across = jitter[0][at] * gsd, jitter[1][at] * gsd
        plane_e = plane_e + by_along * along[0] + by_across * across[0]
        plane_n = plane_n + by_along * along[1] + by_across * across[1]
    heights = scene.height_seen(site) - scene.ground.datum
    centre = scene.geometry.centre[pair]

    def row(north: Array) -> Array:
        return (-(north - centre[1]) / gsd + n / 2 + scene.margin) * fine - 0.5

    def col(east: Array) -> Array:
        return ((east - centre[0]) / gsd + n / 2 + scene.margin) * fine - 0.5

    t = _tangent(scene, pair)
    if abs(t).max() <= 1e-3:
        return row(plane_n), col(plane_e)
    mean = scene.geometry.height[pair] - scene.ground.datum
    east, north = plane_e + t[0] * mean, plane_n + t[1] * mean
    for _ in range(6):  # damped: it converges on steep ground too
        met = ndimage.map_coordinates(heights, [row(north), col(east)], order=1, mode="nearest")
        east = 0.4 * east + 0.6 * (plane_e + met * t[0])
        north = 0.4 * north + 0.6 * (plane_n + met * t[1])
    met = ndimage.map_coordinates(heights, [row(north), col(east)], order=1, mode="nearest")
    return row(plane_n + met * t[1]), col(plane_e + met * t[0])


def _sensed(scene: Scene, detector: Array, patch: Patch, departure: Departure, broad_seed: int) -> Array:
    """The chain from the focal plane to the file, without noise."""
    camera = scene.camera
    if departure.optics:
        detector = departure.optics(detector, patch)
    if departure.echo:
        fraction, lag, axis = departure.echo
        detector = detector + fraction * np.roll(detector, lag, axis=1 if axis == "sample" else 0)
    if departure.dark:
        detector = detector + departure.dark
    if departure.nonlinearity:
        a, b = departure.nonlinearity
        signal = np.maximum(detector, 1e-6)
        detector = detector + a * signal * signal + b * signal * np.log(signal)
    detector = detector * camera.gain[patch.image]
    column = np.clip(patch.samples, 0, camera.width - 1)
    if camera.line_scan:
        detector = detector * camera.flat[column]
    else:
        detector = detector * camera.flat[np.clip(patch.lines, 0, camera.width - 1), column]
    detector = detector * (1 + camera.broad_rms * _broad_field(detector.shape, broad_seed))
    if departure.gain is not None:
        detector = detector * departure.gain[patch.image]
    if departure.columns is not None:
        detector = detector * departure.columns[column]
    if departure.sensor:
        detector = departure.sensor(detector, patch)
    return detector


def _broad_field(shape: tuple[int, int], seed: int) -> Array:
    """Smooth over 12 to 30 px, mean 0, deviation 1."""
    rng = np.random.default_rng(seed)
    length = rng.uniform(12, 30)
    knots = rng.standard_normal((int(shape[0] / length) + 4, int(shape[1] / length) + 4))
    first = int(length)
    field = ndimage.zoom(knots, length, order=3)[first : first + shape[0], first : first + shape[1]]
    return standardised(field)
