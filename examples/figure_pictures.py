"""Make the pictures of README.md again from what `make demo-full` left. Run: make figures

Everything rendered has a gain and an offset fitted to the image. The crop is where the learned reflectance then gains as much over one
coefficient set as on the median test crop, not where it gains most.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import h5py
import matplotlib
import numpy as np
import rasterio
import rasterio.windows

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402

from schemas import read_strings  # noqa: E402

COMPARED = {
    "learned_gain_offset": "learned from terrain",
    "global_gain_offset": "one coefficient set",
    "kernels_gain_offset": "lunar kernels",
    "hapke_gain_offset": "Hapke, published",
}
QUALITY = 88  # of JPEG


def typical_crop(evaluation: h5py.File) -> int:
    """Position of the crop on which the learned reflectance gains over one coefficient set what it gains on the median crop."""
    mse = dict(zip(read_strings(evaluation, "model_name"), evaluation["mse"][...], strict=True))
    ratio = mse["learned_gain_offset"] / mse["global_gain_offset"]
    order = np.argsort(np.where(np.isfinite(ratio), ratio, np.inf))[: int(np.isfinite(ratio).sum())]
    return int(order[len(order) // 2])


def draw_relit(demo: Path, output: Path) -> None:
    """A test image, the same rendered with one reflectance and with the learned one, and the ground under another Sun."""
    with h5py.File(demo / "evaluation.h5") as evaluation, h5py.File(demo / "pairs.h5") as pairs:
        k = typical_crop(evaluation)
        pair = int(evaluation["pair_index"][k])
        measured, rendered = evaluation["measured"][k], renderings(evaluation, k)
        height, width = measured.shape
        top, left = int(pairs["row"][pair]) - height // 2, int(pairs["col"][pair]) - width // 2
    with rasterio.open(demo / "render.tif") as source:
        other = source.read(1, window=rasterio.windows.Window(left, top, width, height), masked=True).filled(np.nan)
    same = tuple(np.nanpercentile(measured, (0.3, 99.7)))
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.6), layout="constrained")
    shown = (
        (measured, same, "image of ground never seen in training"),
        (rendered["global_gain_offset"], same, "rendered with one reflectance everywhere"),
        (rendered["learned_gain_offset"], same, "rendered with reflectance learned from terrain"),
        (other, (0, np.nanpercentile(other, 99.7)), "the learned map with albedo, Sun in the west"),
    )
    for axis, (picture, (black, white), title) in zip(axes, shown, strict=True):
        axis.imshow(picture, cmap="gray", vmin=black, vmax=white, interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    save(figure, output)


def draw_differences(demo: Path, output: Path) -> None:
    """The same crop: measured, rendered by the compared models, and measured minus rendered, in I/F."""
    with h5py.File(demo / "evaluation.h5") as evaluation:
        k = typical_crop(evaluation)
        measured, rendered = evaluation["measured"][k], renderings(evaluation, k)
    columns = [name for name in COMPARED if name in rendered]
    figure, axes = plt.subplots(2, len(columns) + 1, figsize=(2.2 * (len(columns) + 1), 4.7), layout="constrained")
    low, high = np.nanpercentile(measured, (0.3, 99.7))
    residual = {name: measured - rendered[name] for name in columns}
    largest = float(np.nanpercentile(np.abs(np.stack(list(residual.values()))), 98))
    grey = axes[0, 0].imshow(measured, cmap="gray", vmin=low, vmax=high)
    axes[0, 0].set_title("measured", fontsize=10)
    for axis, name in zip(axes[0, 1:], columns, strict=True):
        axis.imshow(rendered[name], cmap="gray", vmin=low, vmax=high)
        axis.set_title(COMPARED[name], fontsize=10)
    for axis, name in zip(axes[1, 1:], columns, strict=True):
        signed = axis.imshow(residual[name], cmap="RdBu_r", vmin=-largest, vmax=largest)
        axis.set_title(f"rms {np.sqrt(np.nanmean(residual[name] ** 2)):.4f}", fontsize=10)
    for axis in axes.flat:
        axis.set_axis_off()
    figure.colorbar(grey, ax=axes[0, :], label="I/F", fraction=0.02)
    figure.colorbar(signed, ax=axes[1, :], label="measured - rendered, I/F", fraction=0.02)
    save(figure, output)


def renderings(evaluation: h5py.File, k: int) -> dict[str, np.ndarray]:
    """Every model's rendering of one crop, (H, W) I/F."""
    names = read_strings(evaluation, "model_name")
    return {name: evaluation["rendered"][n, k] for n, name in enumerate(names)}


def save(figure, output: Path) -> None:
    figure.savefig(output, dpi=110, facecolor="white", pil_kwargs={"quality": QUALITY})
    plt.close(figure)


def shrink(source: Path, output: Path, width: int) -> None:
    """A PNG as JPEG of at most ``width`` px."""
    picture = cv2.imread(str(source), cv2.IMREAD_COLOR)
    scale = min(1.0, width / picture.shape[1])
    size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
    cv2.imwrite(
        str(output), cv2.resize(picture, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    )


def main(root: Path) -> None:
    demo, images = root / "demo-full", root / "docs" / "images"
    needed = ("evaluation.h5", "pairs.h5", "render.tif", "render.png", "figures/match_daisy_1.png")
    missing = [name for name in needed if not (demo / name).is_file()]
    if missing:
        print(f"pictures stay as they are: no demo-full/{missing[0]}; run make demo-full", file=sys.stderr)
        return
    draw_relit(demo, images / "demo_relit.jpg")
    shrink(demo / "render.png", images / "demo_render.jpg", 900)
    draw_differences(demo, images / "demo_crop.jpg")
    shrink(demo / "figures" / "match_daisy_1.png", images / "demo_match.jpg", 1000)


if __name__ == "__main__":
    main(ROOT)
