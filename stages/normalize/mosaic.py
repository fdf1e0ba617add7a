"""One map from many images of the same ground: a weighted median whose weights fade towards the images' edges."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats32, Mask
from stages.physics.images.table import Frame

FADE_PX = 32  # from an edge, a shadow or a grazing slope on, over which the weight of an image rises to its whole
BOUND = 1.5  # standard deviations beyond which an image pulls no harder
ROUNDS = 12
SPREAD = 0.05  # relative standard deviation that is taken where none is known


@dataclass(frozen=True)
class Mosaic:
    """(h, w) each. value : I/F; std : of it; scatter : standard deviation of single images, NaN below two; count : images"""

    value: Floats32
    std: Floats32
    scatter: Floats32
    count: NDArray[np.uint16]


@dataclass(frozen=True)
class Layer:
    """One mosaic. images : the frames of its band; low, high : its phases, deg"""

    name: str
    images: frozenset[int]
    low: float
    high: float


def choose_layers(frames: Sequence[Frame], bins: Sequence[float]) -> list[Layer]:
    """A mosaic of all phases for each band, by wavelength where it is known, and one for each phase bin. bins : edges, deg"""
    members: dict[str, list[int]] = {}
    for k, frame in enumerate(frames):
        known = math.isfinite(frame.wavelength_nm)
        name = f"{frame.wavelength_nm:g}nm" if known else f"band_{frame.band}" if frame.band else ""
        members.setdefault(name, []).append(k)
    layers = []
    for name, images in members.items():
        for low, high in ((0.0, 180.0), *itertools.pairwise(bins)):
            words = [name] if len(members) > 1 else []
            words += [f"phase_{low:g}_{high:g}"] if (low, high) != (0.0, 180.0) else []
            layers.append(Layer("_".join(words), frozenset(images), low, high))
    return layers


def fading_weight(good: Mask) -> Floats32:
    """(h, w) 0..1, how far a pixel lies inside of what is good; what lies outside of the array counts as good."""
    if good.all():
        return np.ones(good.shape, np.float32)
    distance = cv2.distanceTransform(good.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.minimum(distance / FADE_PX, 1.0).astype(np.float32) ** 2


def combine(values: Floats32, std: Floats32, fade: Floats32) -> Mosaic:
    """Huber's location of the images' values: the weighted mean of those that agree, a median where one lies off.

    A weighted median itself jumps from one image to the next where their weights cross, which shows as an edge.

    values, std : (n, h, w), NaN where an image has no value or its error is not known; fade : (n, h, w) weights
    """
    known = np.isfinite(values)
    count = known.sum(axis=0)
    error = np.where(np.isfinite(std), std, SPREAD * np.abs(values))
    error = np.where(known, np.maximum(error, 1e-6 * np.abs(values) + 1e-30), 1)
    filled, weight = np.where(known, values, 0), np.where(known, fade, 0)
    inverse = weight / error**2
    total = np.maximum(inverse.sum(axis=0), 1e-30)
    place = (inverse * filled).sum(axis=0) / total
    for _ in range(ROUNDS):
        pull = inverse * np.minimum(1, BOUND * error / np.maximum(np.abs(filled - place), 1e-30))
        place = (pull * filled).sum(axis=0) / np.maximum(pull.sum(axis=0), 1e-30)
    unseen = count == 0
    sigma = np.where(known, std, 0)
    deviation = np.sqrt(((inverse * sigma) ** 2).sum(axis=0)) / total
    squares = np.where(known, (filled - place) ** 2, 0).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = np.where(count > 1, np.sqrt(squares / (count - 1)), np.nan)
    value, std, scatter = (np.where(unseen, np.nan, v).astype(np.float32) for v in (place, deviation, scatter))
    return Mosaic(value, std, scatter, count.astype(np.uint16))
