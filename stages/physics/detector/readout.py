"""What a sensor makes of an image, in the order of the hardware: optics, response, charge, noise, digits."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats, Floats32
from stages.physics.detector.sensor import Exposure, Sensor

COLUMN_ORDERS = tuple(range(1, 9))  # waves over the columns
LEVEL_PERCENT = 99.5  # of the pixels: automatic exposure looks at this one


def column_wave(order: int, u: Any, cos: Callable[[Any], Any] = np.cos) -> Any:
    """Wave of the response over the columns, rms 1; u : 0..1 from the first to the last column, any kind of array that ``cos`` takes."""
    return math.sqrt(2) * cos(math.pi * order * u)


def noise_electrons(charge: Floats32, read_noise: float, rng: np.random.Generator) -> Floats32:
    """Noise of photons and readout, e-: normal, with the variance of both (Janesick 2007, Photon Transfer).

    charge : (H, W), e-
    """
    sigma = np.sqrt(np.maximum(charge, 0) + np.float32(read_noise**2))
    return rng.standard_normal(charge.shape, dtype=np.float32) * sigma


def blur(sensor: Sensor, image: Floats32) -> Floats32:
    """The image behind the optics, the same light in sum; image : (H, W) I/F."""
    if sensor.psf_kernel is not None:
        turned = np.asarray(sensor.psf_kernel)[::-1, ::-1]  # OpenCV correlates
        return np.asarray(cv2.filter2D(image, cv2.CV_32F, turned, borderType=cv2.BORDER_REFLECT), np.float32)
    if sensor.psf_sigma_px == 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sensor.psf_sigma_px, borderType=cv2.BORDER_REFLECT), np.float32)


def photograph(sensor: Sensor, image: Floats32, distance_au: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """The DN of a whole image; unknown ground gives no light.

    image : (H, W) I/F; distance_au : of the Sun; rng : of the noise
    """
    light = blur(sensor, np.nan_to_num(image))
    lit = light[light > 0]
    exposure = sensor.expose(float(np.percentile(lit, LEVEL_PERCENT)) if lit.size else 0.0, distance_au)
    x, y = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in image.shape[::-1])
    return read_out(sensor, light, exposure, x[None], y[:, None], rng)


def read_out(
    sensor: Sensor, light: Floats32, exposure: Exposure, x: Floats, y: Floats, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """DN of light on the focal plane.

    light : (H, W) I/F; x, y : where on the detector, -1..1 from edge to edge, broadcastable to it; rng : of the noise
    """
    signal = light * (exposure.electrons * _response(sensor, light.shape, x, y))
    if sensor.dark_signal:
        pattern = np.random.default_rng([sensor.seed, 2]).standard_normal(light.shape)
        signal = signal + sensor.dark_signal * exposure.seconds * np.maximum(1 + sensor.dsnu * pattern, 0)
    charge = signal.astype(np.float32)
    charge = np.minimum(charge + noise_electrons(charge, 0.0, rng), np.float32(sensor.full_well))
    read = charge + noise_electrons(np.zeros_like(charge), sensor.read_noise, rng)
    return np.clip(np.rint(read / sensor.electrons_per_dn + sensor.offset_dn), 0, sensor.top).astype(np.uint16)


def _response(sensor: Sensor, shape: tuple[int, ...], x: Floats, y: Floats) -> Floats:
    """(H, W) response about 1: vignetting, pixels, columns."""
    response = 1 - sensor.vignetting * 0.5 * (x * x + y * y)
    if sensor.prnu:
        response = response * (1 + sensor.prnu * np.random.default_rng([sensor.seed, 0]).standard_normal(shape))
    if sensor.column_pattern:
        weights = np.random.default_rng([sensor.seed, 1]).standard_normal(len(COLUMN_ORDERS))
        weights *= sensor.column_pattern / np.linalg.norm(weights)
        waves = (w * column_wave(k, 0.5 * (x + 1)) for w, k in zip(weights, COLUMN_ORDERS, strict=True))
        response = response * (1 + sum(waves))
    return np.broadcast_to(response, shape)
