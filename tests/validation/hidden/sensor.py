"""The camera: a detector that looks at the ground turned and shifted, its faults, and the map projection back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter
from scipy.special import ndtri

from hidden.faults import FAULTS, LAST


@dataclass
class Detector:
    """Faults of one camera; the defaults have none but noise. Everything acts on detector pixels, in I/F or DN."""

    snr: float = 70.0  # at the mean brightness, from photons, read-out and quantisation together
    read: float = 18.0  # electrons rms
    uneven: float = 0.002  # rms by which single pixels differ in response: fixed on the detector
    full_scale: float = 0.4  # I/F of the last DN step
    bits: int = 12
    veil: float = 0.0  # rms of broad correlated noise (stray light, compression, scanning), relative to the mean
    veil_px: float = 12.0  # sigma of its correlation
    gain: float = 1.0
    bias: float = 0.0
    gamma: float = 0.0  # response I^(1 + gamma), scaled to keep the mean
    quadratic: float = 0.0
    blur_sigma: float = 0.0
    smear: tuple[float, int, int] | None = None  # share, lag, axis
    response: Any = None  # function of sample
    level: float = np.inf
    ghost: Any = None  # function (sample, line) -> share of the mean signal: not in the catalogue
    faults: dict[str, dict[str, Any]] = field(default_factory=dict)  # name -> values: none is in the catalogue
    warp: Any = None  # function line -> (samples, lines) that the platform moved


@dataclass
class Pose:
    """Where the detector's pixels lie: rotation and offset against the crop, in px, and the error of the metadata."""

    rotation_deg: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    error: tuple[float, float] = (0.0, 0.0)  # (rows, columns): what misregistration leaves
    first: tuple[float, float] = (1000.0, 2000.0)  # line and sample of the crop's centre
    extras: dict = field(default_factory=dict)


def shoot(rng, fine: np.ndarray, sub: int, border: int, size: int, pose: Pose, camera: Detector):
    """Fine I/F -> orthorectified (image, detector_sample, detector_line), each (size, size).

    fine : ((size + 2 border) sub,)^2, radiance on the ground; an image pixel is the mean over its area
    """
    box = uniform_filter(fine.astype(np.float64), sub, mode="nearest")
    span = size + 2 * border - 4
    half = (span - 1) / 2
    turn = np.radians(pose.rotation_deg)
    c, s = np.cos(turn), np.sin(turn)
    line, sample = np.mgrid[0:span, 0:span] - half
    if camera.warp is not None:
        across, along = camera.warp((np.arange(span) - half) / size)
        sample, line = sample + across[:, None], line + along[:, None]
    rows = c * line - s * sample + pose.offset[0]
    columns = s * line + c * sample + pose.offset[1]
    centre = (fine.shape[0] - 1) / 2
    seen = map_coordinates(box, [rows * sub + centre, columns * sub + centre], order=1, mode="nearest")
    recorded = expose(rng, seen, pose, camera)

    grid = np.arange(size) - (size - 1) / 2
    r, q = np.meshgrid(grid, grid, indexing="ij")
    r, q = r - pose.offset[0] + pose.error[0], q - pose.offset[1] + pose.error[1]
    back_line, back_sample = c * r + s * q, -s * r + c * q
    image = map_coordinates(recorded, [back_line + half, back_sample + half], order=3, mode="nearest")
    return image, back_sample + pose.first[1], back_line + pose.first[0]


def expose(rng, seen: np.ndarray, pose: Pose, camera: Detector) -> np.ndarray:
    """Radiance on the detector -> I/F as the calibrated product gives it."""
    span = seen.shape[0]
    half = (span - 1) / 2
    samples = np.arange(span) - half + pose.first[1]
    lines = np.arange(span) - half + pose.first[0]
    signal = seen
    if camera.blur_sigma > 0:
        signal = gaussian_filter(signal, camera.blur_sigma, mode="nearest")
    for name, values in camera.faults.items():
        if name not in LAST:
            signal = FAULTS[name](signal, samples, lines, **values)
    if camera.ghost is not None:
        signal = signal + signal.mean() * camera.ghost(samples[None], lines[:, None])
    signal = signal * camera.gain
    if camera.smear is not None:
        share, lag, axis = camera.smear
        # charge left behind at transfer comes out ``lag`` pixels later
        late = np.roll(signal, lag, axis=1 if axis == 0 else 0)
        signal = signal + share * late
    if camera.response is not None:
        signal = signal * camera.response(samples)[None]
    mean = 0.05
    signal = np.clip(signal, 0, None)
    if camera.veil > 0:
        broad = gaussian_filter(rng.normal(size=signal.shape), camera.veil_px, mode="nearest")
        signal = np.clip(signal + signal.mean() * camera.veil * broad / broad.std(), 0, None)
    # electrons at the mean brightness: n of them scatter by sqrt(n + read^2)
    n = camera.snr * (camera.snr + np.sqrt(camera.snr**2 + 4 * camera.read**2)) / 2
    per_electron = max(float(signal.mean()), 1e-9) / n
    pixels = np.random.default_rng(20).normal(size=signal.shape)  # the detector's own, the same in every image
    expected = signal / per_electron * np.clip(1 + camera.uneven * pixels, 0.9, 1.1)
    # Poisson's quantiles (Cornish & Fisher 1938): drawn by rejection, a little more light somewhere would shuffle the noise of all pixels after it
    normal = ndtri(rng.random(signal.shape))
    counted = np.maximum(np.round(expected + np.sqrt(expected) * normal + (normal**2 - 1) / 6), 0)
    electrons = (counted + rng.normal(size=signal.shape) * camera.read) * per_electron
    if camera.gamma:
        electrons = mean * np.sign(electrons) * (np.abs(electrons) / mean) ** (1 + camera.gamma)
    if camera.quadratic:
        electrons = electrons + camera.quadratic * electrons**2
    for name, values in camera.faults.items():
        if name in LAST:
            electrons = FAULTS[name](electrons, samples, lines, **values)
    electrons = np.minimum(electrons, camera.level) + camera.bias
    # companded to the bits of the link, as most flight cameras do: steps grow with the root of the signal
    steps = 2**camera.bits / 4
    root = np.round(np.sqrt(np.clip(electrons / camera.full_scale, 0, None)) * steps) / steps
    return root**2 * camera.full_scale
