"""The camera: its optics, its pose over the scene, and the small faults that every sensor has."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import j1

from .fields import Array, log_uniform, standardised
from .layout import Needs
from .resampling import BILINEAR, CUBIC

PSF_SAMPLES = 10  # per detector pixel
PSF_HALF = 70  # samples from the centre to the border


@dataclass
class Camera:
    """One camera that takes all images; what differs from image to image has that length first."""

    line_scan: bool
    rotation: Array  # (images,), rad
    pitch: Array  # (images,), m on the ground per detector pixel at nadir
    psf_kind: str
    psf_fwhm: float  # detector px
    psf: Array  # (141, 141), 10 samples to a detector pixel, with the pixel's own square
    resampling: int  # of the map projection
    snr: float  # at the mean signal
    read_share: float  # of the noise's variance
    gain_rms: float
    flat_rms: float
    broad_rms: float  # of a smooth residual field
    registration_rms: float  # px
    gain: Array  # (images,)
    shift: Array  # (images, 2), px east and north
    affine: Array  # (images, 2, 2), detector px (sample, line) per m (east, north)
    width: int  # detector px
    offset: Array  # (images, 2): sample and line where the scene's centre falls
    flat: Array  # (width,) of a line, or (width, width) of a frame


def draw_camera(
    rng: np.random.Generator, needs: Needs, gsd: float, grid: int, emission: Array, view_azimuth: Array
) -> Camera:
    """Emission and azimuth of view in degrees, per image; grid: px of the scene."""
    images = len(emission)
    line_scan = bool(rng.random() < 0.65)
    if needs.line_scan is not None:
        line_scan = needs.line_scan
    turned = rng.random() * 360 if rng.random() < 0.4 else 0.0
    if rng.random() < 0.7:
        rotation = turned + rng.choice([0, 180], images) + rng.normal(0, 8, images)
    else:
        rotation = rng.random(images) * 360
    rotation = np.radians(rotation)
    pitch = gsd * rng.uniform(0.75, 0.97) * rng.uniform(0.97, 1.03, images)
    psf_kind = str(rng.choice(["moffat", "airy"]))
    psf_fwhm = rng.uniform(1.2, 1.6)
    psf = point_spread(psf_kind, psf_fwhm, rng.uniform(2.5, 4.5))
    resampling = int(rng.choice([BILINEAR, CUBIC]))
    snr = log_uniform(rng, 40, 150)
    read_share = rng.uniform(0.05, 0.35)
    gain_rms = 0.003 * rng.uniform(0.7, 1.2)
    flat_rms = 0.002 * rng.uniform(0.7, 1.2)
    broad_rms = rng.uniform(0.002, 0.006)
    registration_rms = 0.2 * rng.uniform(0.7, 1.15)
    gain = 1 + gain_rms * rng.standard_normal(images)
    shift = rng.normal(0, registration_rms / math.sqrt(2), (images, 2))
    affine = np.array([_affine(*pose) for pose in zip(emission, view_azimuth, rotation, pitch, strict=True)])
    corners = np.array([[1, 1], [1, -1]]).T * (grid * gsd / 2 + 40 * gsd)
    seen = max(2 * np.abs(a @ corners).max() for a in affine)
    width = int(math.ceil(seen + rng.uniform(60, 500)))
    half = seen / 2
    offset = []
    for _ in range(images):
        sample = rng.uniform(half + 1, width - half - 1)
        line = rng.uniform(half + 1, 9 * half) if line_scan else rng.uniform(half + 1, width - half - 1)
        offset.append([sample, line])
    flat = _draw_flat(rng, flat_rms, (width,), 0.8, 0.6, 15)
    if not line_scan:
        flat = _draw_flat(rng, flat_rms, (width, width), 0.7, 0.7, 12).astype(np.float32)
    return Camera(
        line_scan, rotation, pitch, psf_kind, psf_fwhm, psf, resampling, snr, read_share, gain_rms, flat_rms, broad_rms,
        registration_rms, gain, shift, affine, width, np.array(offset), flat,
    )  # fmt: skip


def _affine(emission: float, view_azimuth: float, rotation: float, pitch: float) -> Array:
    """(2, 2): metres east, north in the plane to detector samples and lines, foreshortened towards the camera."""
    e, azimuth = math.radians(emission), math.radians(view_azimuth)
    towards = np.array([math.sin(azimuth), math.cos(azimuth)])
    foreshortened = np.eye(2) - (1 - math.cos(e)) * np.outer(towards, towards)
    flip = np.array([[1, 0], [0, -1]])  # lines run down
    c, s = math.cos(rotation), math.sin(rotation)
    return np.array([[c, -s], [s, c]]) @ flip @ foreshortened / pitch


def _draw_flat(
    rng: np.random.Generator, rms: float, shape: tuple[int, ...], white: float, smooth: float, length: float
) -> Array:
    """What flat-fielding left: noise from pixel to pixel and a part that is smooth over `length` px."""
    rough = white * rng.standard_normal(shape)
    return 1 + rms * (rough + smooth * standardised(ndimage.gaussian_filter(rng.standard_normal(shape), length)))


def point_spread(kind: str, fwhm: float, shape: float) -> Array:
    """(141, 141), sum 1: Moffat's profile or Airy's blurred a little, with the pixel's square, of a total FWHM in detector px.

    shape: Moffat's exponent (1969, A&A 3, 455).
    """
    u = np.arange(-PSF_HALF, PSF_HALF + 1) / PSF_SAMPLES
    r = np.hypot(u[:, None], u[None])

    def total(optics: float) -> Array:
        if kind == "moffat":
            a = optics / 2 / math.sqrt(2 ** (1 / shape) - 1)
            profile = (1 + (r / a) ** 2) ** -shape
        else:
            x = np.maximum(r * 3.2327 / optics, 1e-6)  # FWHM = 1.029 wavelength / aperture
            profile = (2 * j1(x) / x) ** 2
            profile = ndimage.gaussian_filter(profile, 0.12 * PSF_SAMPLES * optics)
        boxed = ndimage.uniform_filter(profile, PSF_SAMPLES)
        return boxed / boxed.sum()

    low, high = 0.15, 1.8
    for _ in range(18):
        middle = 0.5 * (low + high)
        if _full_width(total(middle)) < fwhm:
            low = middle
        else:
            high = middle
    return total(middle)


def _full_width(psf: Array) -> float:
    """Detector px at half its maximum."""
    cut = psf[PSF_HALF, PSF_HALF:] / psf[PSF_HALF, PSF_HALF]
    q = np.argmax(cut < 0.5)
    return 2 * (q - 1 + (cut[q - 1] - 0.5) / (cut[q - 1] - cut[q])) / PSF_SAMPLES
