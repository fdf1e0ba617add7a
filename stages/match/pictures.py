"""Pictures in and out of matching: sizes, grey levels, and matches drawn in the colour of their error."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
from rasterio.errors import RasterioError

from schemas.errors import InputError
from schemas.files.references import open_raster_file
from stages.match.base import Matches

WIDTH, HEIGHT = 512, 384  # the size at which the Lunar-G2R paper reports errors
DRAWN = 250  # matches per picture, so that single ones stay visible


def read_picture(path: Path) -> np.ndarray:
    """The first band of an image file that OpenImageIO or GDAL reads, (H, W) float32, NaN where nodata."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an image file.")
    if path.suffix.lower() != ".exr":
        with contextlib.suppress(RasterioError), open_raster_file(path) as source:
            return source.read(1, masked=True).astype(np.float32).filled(np.nan)
    image = oiio.ImageBuf(str(path))
    pixels = image.get_pixels(oiio.FLOAT) if image.initialized and not image.has_error else None
    if pixels is None or pixels.size == 0:
        raise InputError(
            f"{path}: expected an image (TIFF, PNG, EXR, ...), found another kind of file or a damaged one."
        )
    return pixels.reshape(*pixels.shape[:2], -1)[:, :, 0].astype(np.float32)


def fit_size(image: np.ndarray) -> np.ndarray:
    """(H, W) -> (384, 512): enlarged or shrunk to cover it, of which the middle is cut out; alike for images of one size.

    A square crop becomes 512 x 512 and loses its upper and lower 64 rows, as pictures do on their way into MASt3R.
    """
    height, width = image.shape
    scale = max(WIDTH / width, HEIGHT / height)
    size = (max(WIDTH, round(width * scale)), max(HEIGHT, round(height * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    resized = cv2.resize(image.astype(np.float32), size, interpolation=method)
    top, left = (size[1] - HEIGHT) // 2, (size[0] - WIDTH) // 2
    return resized[top : top + HEIGHT, left : left + WIDTH]


def stretch_limits(image: np.ndarray) -> tuple[float, float]:
    """Values shown black and white: the 0.5 and 99.5 % quantiles of the known pixels of an image (H, W)."""
    known = image[np.isfinite(image)]
    if not len(known):
        return 0.0, 1.0
    low, high = np.quantile(known, (0.005, 0.995))
    return float(low), float(high) if high > low else float(low) + 1.0


def to_grey(image: np.ndarray, limits: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """An image (H, W) at 512 x 384: uint8 grey levels, and where it is known; unknown pixels take the mean grey.

    limits : the values shown black and white
    """
    known = np.isfinite(image)
    filled = np.where(known, image, image[known].mean() if known.any() else 0.0)
    low, high = limits
    grey = np.clip((fit_size(filled) - low) / (high - low) * 255, 0, 255).round().astype(np.uint8)
    return grey, fit_size(known.astype(np.float32)) > 0.999


def drop_unknown(matches: Matches, known: np.ndarray) -> Matches:
    """The matches whose both ends lie on pixels that are ``known``, (H, W) bool."""
    keep = np.ones(len(matches.measured), bool)
    for points in (matches.measured, matches.rendered):
        x = np.clip(points[:, 0].round().astype(int), 0, known.shape[1] - 1)
        y = np.clip(points[:, 1].round().astype(int), 0, known.shape[0] - 1)
        keep &= known[y, x]
    return Matches(matches.measured[keep], matches.rendered[keep])


def match_figure(measured: np.ndarray, rendered: dict[str, np.ndarray], matches: dict[str, Matches], title: str) -> Any:
    """Measured picture beside every rendered one; dots in green (0 px) to red (5 px and more), lines to the match."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection

    colours = plt.get_cmap("RdYlGn_r")
    figure, axes = plt.subplots(
        len(rendered), 2, figsize=(9, 3.55 * len(rendered)), squeeze=False, layout="constrained"
    )
    for (name, picture), (left, right) in zip(rendered.items(), axes, strict=True):
        found = matches[name]
        order = np.random.default_rng(0).permutation(len(found.errors))[:DRAWN]
        order = order[np.argsort(found.errors[order])]  # the worst on top
        shade = np.clip(found.errors[order] / 5, 0, 1)
        left.imshow(measured, cmap="gray", vmin=0, vmax=255)
        right.imshow(picture, cmap="gray", vmin=0, vmax=255)
        dots = left.scatter(*found.measured[order].T, c=shade * 5, cmap=colours, vmin=0, vmax=5, s=9)
        right.scatter(*found.rendered[order].T, c=shade * 5, cmap=colours, vmin=0, vmax=5, s=9)
        ends = np.stack([found.measured[order], found.rendered[order]], axis=1)
        right.add_collection(LineCollection(list(ends), colors=colours(shade), linewidths=0.8))
        mean = f"{found.errors.mean():.1f} px" if len(found.errors) else "-"
        left.set_title("measured", fontsize=9)
        right.set_title(f"{name.replace('_', ' ')}: {len(found.errors)} matches, mean error {mean}", fontsize=9)
        for axis in (left, right):
            axis.set(xlim=(-0.5, WIDTH - 0.5), ylim=(HEIGHT - 0.5, -0.5))
            axis.set_axis_off()
    figure.colorbar(dots, ax=axes, fraction=0.025, pad=0.01, label="matching error, px (5: 5 and more)")
    figure.suptitle(title, fontsize=10)
    return figure
