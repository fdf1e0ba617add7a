"""Make the pictures of README.md again from what `make demo` left. Run: make figures

The crop is where the learned reflectance has its median error on the test pairs, not its best.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import rasterio

ROOT = Path(__file__).resolve().parent.parent
QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 88]


def median_crop(evaluation: h5py.File) -> int:
    """Position of the crop with the median error of the first row, the learned one."""
    mse = evaluation["mse"][0]
    order = np.argsort(np.where(np.isfinite(mse), mse, np.inf))[: int(np.isfinite(mse).sum())]
    return int(order[len(order) // 2])


def relit(demo: Path, output: Path) -> None:
    """A test image, the same rendered from terrain alone, and the same ground under another Sun."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with h5py.File(demo / "evaluation.h5") as evaluation, h5py.File(demo / "pairs.h5") as pairs:
        k = median_crop(evaluation)
        pair = int(evaluation["pair_index"][k])
        measured, rendered = evaluation["measured"][k], evaluation["rendered"][0, k]
        height, width = measured.shape
        top, left = int(pairs["row"][pair]) - height // 2, int(pairs["col"][pair]) - width // 2
    with rasterio.open(demo / "render.tif") as source:
        other = source.read(1, window=rasterio.windows.Window(left, top, width, height), masked=True).filled(np.nan)
    low, high = np.nanpercentile(measured, (0.3, 99.7))
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.8), layout="constrained")
    shown = (
        (measured, (low, high), "image of ground never seen in training"),
        (rendered, (low, high), "rendered from terrain alone, same Sun"),
        (other, (0, np.nanpercentile(other, 99.7)), "the learned map with albedo, Sun in the west"),
    )
    for axis, (picture, (black, white), title) in zip(axes, shown, strict=True):
        axis.imshow(picture, cmap="gray", vmin=black, vmax=white, interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    figure.savefig(output, dpi=130, facecolor="white", pil_kwargs={"quality": 88})
    plt.close(figure)


def smaller(source: Path, output: Path, width: int) -> None:
    """A PNG as JPEG of at most ``width`` px."""
    picture = cv2.imread(str(source), cv2.IMREAD_COLOR)
    scale = min(1.0, width / picture.shape[1])
    size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
    cv2.imwrite(str(output), cv2.resize(picture, size, interpolation=cv2.INTER_AREA), QUALITY)


def main(root: Path) -> None:
    demo, images = root / "demo", root / "docs" / "images"
    needed = (
        "evaluation.h5",
        "pairs.h5",
        "render.tif",
        "render.png",
        "figures/crop_median.png",
        "figures/match_daisy_1.png",
    )
    missing = [name for name in needed if not (demo / name).is_file()]
    if missing:
        print(f"pictures stay as they are: no demo/{missing[0]}; run make demo", file=sys.stderr)
        return
    relit(demo, images / "demo_relit.jpg")
    smaller(demo / "render.png", images / "demo_render.jpg", 900)
    smaller(demo / "figures" / "crop_median.png", images / "demo_crop.jpg", 1400)
    smaller(demo / "figures" / "match_daisy_1.png", images / "demo_match.jpg", 1000)


if __name__ == "__main__":
    main(ROOT)
