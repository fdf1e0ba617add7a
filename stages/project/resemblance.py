"""How much an image resembles the rendering of its ground, beside what chance gives.

A wrong place, Sun, DEM or unit shows here, whatever its cause. Chance is measured, not assumed: the same image is
compared with its renderings turned, mirrored, and exchanged between places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.physics.horizon.scene import SceneTerrain
from stages.physics.images.correlation import small_structure
from stages.physics.images.displacement import Field
from stages.physics.images.register_frame import render_region
from stages.physics.images.registration import LEAST_PIXELS
from stages.physics.images.source_images import Source
from stages.physics.images.table import Frame
from stages.physics.maps.window import Box
from stages.project.summary import Resemblance

BLOCKS = 16  # per image: 127 turned, mirrored and exchanged renderings then tell what chance gives


def compare_with_rendering(
    frame: Frame, source: Source, terrain: SceneTerrain, blocks: Sequence[Box], field: Field | None = None
) -> Resemblance:
    """Compare an image with the rendering of a uniform surface, on ``blocks`` of the grid.

    field : the displacement that registration subtracts
    """
    images, renderings, means = [], [], []
    for row, col, height, width in blocks:
        edge = min(height, width)
        z = np.asarray(terrain.elevation[row : row + edge, col : col + edge], np.float32)
        pixels = source.read(row, col, edge, edge, field)
        good = pixels.valid & np.isfinite(z)
        if good.sum() < LEAST_PIXELS:
            continue
        rendering = render_region(frame, z, terrain, row, col)[0]
        values = np.where(good, pixels.values, 0.0).astype(float)
        images.append(small_structure(values, good))
        renderings.append(small_structure(np.where(good, rendering, 0.0), good))
        means.append((values[good].mean(), rendering[good].mean()))
    if not images:
        return Resemblance(frame.image_id, *[math.nan] * 4)
    correlation, chance = _correlations(np.stack(images), np.stack(renderings))
    image, rendering = np.array(means).T
    relative = [
        s / m[:, None, None] for s, m in ((np.stack(images), image), (np.stack(renderings), rendering)) if m.all()
    ]
    contrast = math.nan
    if len(relative) == 2 and relative[1].any():
        contrast = float((relative[0] * relative[1]).sum() / (relative[1] ** 2).sum())
    return Resemblance(frame.image_id, correlation, chance, contrast, float(image.mean()))


def _correlations(images: NDArray[np.float64], renderings: NDArray[np.float64]) -> tuple[float, float]:
    """(n, h, h) each -> the mean correlation of images with their renderings, and the largest with any others.

    The others are the renderings turned and mirrored in the seven ways of a square, and each of these, and the
    renderings as they are, exchanged between the blocks in cycles: 8 n - 1 in all.
    """
    a = _normalised(images)
    means: list[Floats] = []
    for mirrored in (renderings, renderings[:, :, ::-1]):
        for turns in range(4):
            products = a @ _normalised(np.rot90(mirrored, turns, axes=(1, 2))).T
            count = len(products)
            cycles = [products[np.arange(count), (np.arange(count) + k) % count].mean() for k in range(count)]
            means.append(np.array(cycles))
    every = np.concatenate(means)
    return float(every[0]), float(every[1:].max())


def _normalised(pictures: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, h, h) -> (n, h * h) of unit length, 0 where there is no structure."""
    flat = pictures.reshape(len(pictures), -1)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.divide(flat, length, out=np.zeros_like(flat), where=length > 0)
