"""Draw the pictures of README.md and docs/ from the files of `make demo-full` and `make reproduce-apollo15`. Run: make figures

All renderings have a gain and an offset fitted to the image. The crop of the demo is the one on which the learned reflectance gains as
much over one coefficient set as on the median test crop.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import matplotlib
import numpy as np
import rasterio
import rasterio.warp
import rasterio.windows

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402

from schemas import read_strings  # noqa: E402
from schemas.packing import read  # noqa: E402

COMPARED = {
    "learned_gain_offset": "learned from terrain",
    "global_gain_offset": "one coefficient set",
    "kernels_gain_offset": "lunar kernels",
    "hapke_gain_offset": "Hapke, published",
}
QUALITY = 88  # of JPEG
FRAME = 2  # of the five Apollo 15 frames, the one that fold 3 of 5 leaves out of the albedo
EVENING = ("--sun-azimuth", "90", "--sun-elevation", "12")


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


def draw_apollo15(folder: Path, output: Path) -> None:
    """A photograph, its renderings with one reflectance and with the learned one, the residuals, and the map under a low Sun."""
    with h5py.File(folder / "scene.h5") as scene:
        own = {name: scene[name][FRAME] for name in scene if name.startswith(("subsolar", "spacecraft"))}
        name, path = (read_strings(scene, variable)[FRAME] for variable in ("image_id", "path"))
    measured = mosaic(folder / "pairs.h5")
    at = [f"{own[f'spacecraft_{part}']:.6f}" for part in ("longitude_deg", "latitude_deg", "altitude_m")]
    geometry = ["--position", ",".join(at)]
    for angle in ("longitude", "latitude"):
        geometry += [f"--subsolar-{angle}", f"{own[f'subsolar_{angle}_deg']:.6f}"]
    learned = rendered(folder, "fold_3.h5", *geometry)
    uniform = rendered(folder, "--dem", "scene.h5", "--model", "hapke", *geometry)
    evening = rendered(folder, "fold_3.h5", *EVENING)
    photograph = on_grid(folder / path, folder / "picture.tif")
    known = np.isfinite(measured) & np.isfinite(learned) & np.isfinite(uniform)
    window = inner_window(known)
    photograph, evening = photograph[window], evening[window]
    measured, learned, uniform, known = (v[window] for v in (measured, learned, uniform, known))
    fits = [fitted(picture, measured, known) for picture in (uniform, learned)]
    low, high = np.percentile(measured[known], (0.5, 99.5))
    span = high - low
    figure, axes = plt.subplots(2, 3, figsize=(12, 8.3), layout="constrained")
    grey = {"cmap": "gray", "vmin": low, "vmax": high, "interpolation": "lanczos"}
    shown = [
        (photograph, grey, f"Apollo 15 photograph {name}"),
        (fits[0], grey, "rendered with one reflectance (Hapke)"),
        (fits[1], grey, "rendered with learned reflectance and albedo"),
        (
            evening,
            {"cmap": "gray", "vmin": 0, "vmax": np.nanpercentile(evening, 99.7)},
            "the learned map under a low Sun",
        ),
    ]
    for fit in fits:
        residual = measured - fit
        share = 100 * np.sqrt(np.mean(residual[known] ** 2)) / span
        shown.append(
            (
                residual,
                {"cmap": "RdBu_r", "vmin": -span / 3, "vmax": span / 3},
                f"residual: rms {share:.0f} % of the range",
            )
        )
    for axis, (picture, style, title) in zip(axes.flat, shown, strict=True):
        axis.imshow(picture, **style)
        axis.set_title(title, fontsize=11)
        axis.set_axis_off()
    save(figure, output)


def mosaic(pairs: Path) -> np.ndarray:
    """The frame as its registered crops show it on the scene's grid, DN, NaN where none does."""
    with h5py.File(pairs) as file, h5py.File(pairs.parent / "scene.h5") as scene:
        chosen = np.flatnonzero(file["image_index"][...] == FRAME)
        total = np.zeros((2, *scene["elevation"].shape))
        size = file["image"].shape[1]
        for k in chosen:
            valid = file["valid"][k] == 1
            top, left = (int(file[name][k]) - size // 2 for name in ("row", "col"))
            place = (slice(None), slice(top, top + size), slice(left, left + size))
            total[place] += np.stack([np.where(valid, read(file["image"], k), 0), valid])
    return np.where(total[1] > 0, total[0] / np.maximum(total[1], 1), np.nan)


def on_grid(path: Path, grid: Path) -> np.ndarray:
    """The photograph as it is map-projected, on the grid of another raster."""
    with rasterio.open(grid) as target, rasterio.open(path) as source:
        found = np.zeros(target.shape, np.float32)
        rasterio.warp.reproject(
            rasterio.band(source, 1),
            found,
            dst_transform=target.transform,
            dst_crs=target.crs,
            resampling=rasterio.warp.Resampling.average,
        )
    return found


def rendered(folder: Path, *words: str) -> np.ndarray:
    """What `lunargr render` gives, I/F on the scene's grid."""
    command = [
        sys.executable,
        "-m",
        "lunargr_cli.main",
        "render",
        *words,
        "-o",
        "picture.tif",
        "--overwrite",
        "--quiet",
    ]
    subprocess.run(command, cwd=folder, check=True)
    with rasterio.open(folder / "picture.tif") as source:
        return source.read(1, masked=True).filled(np.nan)


def fitted(picture: np.ndarray, measured: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The picture with the gain and the offset that suit the measured one best."""
    gain, offset = np.polyfit(picture[known], measured[known], 1)
    return gain * picture + offset


def inner_window(known: np.ndarray) -> tuple[slice, slice]:
    """The middle of what is known: the middle three fifths of its rows and columns."""
    found = []
    for axis in (1, 0):
        where = np.flatnonzero(known.any(axis=axis))
        middle, half = (where[0] + where[-1]) // 2, int(0.3 * (where[-1] - where[0]))
        found.append(slice(middle - half, middle + half))
    return found[0], found[1]


def renderings(evaluation: h5py.File, k: int) -> dict[str, np.ndarray]:
    """Every model's rendering of one crop, (H, W) I/F."""
    names = read_strings(evaluation, "model_name")
    return {name: evaluation["rendered"][n, k] for n, name in enumerate(names)}


def save(figure, output: Path) -> None:
    figure.savefig(output, dpi=110, facecolor="white", pil_kwargs={"quality": QUALITY})
    plt.close(figure)


def main(root: Path) -> None:
    demo, apollo, images = root / "demo-full", root / "results" / "apollo15", root / "docs" / "images"
    if has(demo, "make demo-full", "evaluation.h5", "pairs.h5", "render.tif"):
        draw_relit(demo, images / "demo_relit.jpg")
        draw_differences(demo, images / "demo_crop.jpg")
    if has(apollo, "make reproduce-apollo15", "scene.h5", "pairs.h5", "fold_3.h5"):
        draw_apollo15(apollo, images / "apollo15.jpg")


def has(folder: Path, command: str, *names: str) -> bool:
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        print(
            f"pictures of {folder.name} stay as they are: no {folder.name}/{missing[0]}; run {command}", file=sys.stderr
        )
    return not missing


if __name__ == "__main__":
    main(ROOT)
