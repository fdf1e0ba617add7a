"""Judge invented detail on the embedded scene: a DEM reduced four times with detail beside the whole one, and without detail.

    python tests/validation/detail.py [--size 768] [--scenes 4] [--output results/detail]

Writes OUTPUT.json, which examples/figures.py reads, and OUTPUT.png: spectra of slope and of brightness, and the pictures.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from pathlib import Path

import cv2
import numpy as np
from rasterio.transform import Affine

from stages.physics.maps.geotiff import MapTiff
from stages.physics.maps.grid import Grid, local_metric_crs
from stages.physics.maps.window import Window
from stages.physics.relief.detail import Detail
from stages.render.grounds import coarsen
from stages.render.renderer import Renderer
from stages.simulate import make_config
from stages.simulate.terrain import Terrain

REDUCED = 4
SUNS_DEG = (15.0, 30.0, 45.0)
ALTITUDE, RADIUS = 60e3, 1737400.0
BORDER = 32  # pixels that are left out
NAMES = ("whole", "with detail", "without")
BANDS = ((0.5, 1.0), (1.0, 2.0), (2.0, 3.2))  # of the reduced DEM's Nyquist frequency


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=768, help="pixels of the whole DEM's side")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=100, help="of the first scene")
    parser.add_argument("--output", type=Path, default=Path("results/detail"))
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    runs = [judge(options.size, seed) for seed in range(options.seed, options.seed + options.scenes)]
    summary = summarise([run[0] for run in runs])
    options.output.with_suffix(".json").write_text(json.dumps(summary, indent=1) + "\n")
    draw(runs[0][1], runs[0][2], summary, options.output.with_suffix(".png"))
    print(json.dumps(summary, indent=1))


def judge(size: int, seed: int) -> tuple[dict, dict, dict]:
    """Numbers, spectra and pictures of one scene."""
    config = make_config({"seed": seed + 11, "size_px": size // 2, "gsd": 5.0, "dem_gsd": 2.5})
    whole = Terrain(config).block(0, 0, size, size).elevation
    grid = make_grid(size, config.dem_gsd)
    reduced, coarse = coarsen(whole, REDUCED), make_grid(size // REDUCED, REDUCED * config.dem_gsd)
    detail = Detail(reduced, coarse, seed + 1, 0.01)
    detailed = detail.heights(Window(0, 0, *reduced.shape), REDUCED)
    smooth = cv2.resize(reduced, (size, size), interpolation=cv2.INTER_LINEAR)
    heights = dict(zip(NAMES, (whole, detailed, smooth), strict=True))
    spectra = {"slope": {name: spectrum(slopes(z, config.dem_gsd)) for name, z in heights.items()}}
    with tempfile.TemporaryDirectory() as folder:
        files = {"whole": write(Path(folder) / "whole.tif", whole, grid)}
        files["without"] = files["with detail"] = write(Path(folder) / "reduced.tif", reduced, coarse)
        pictures = {
            n: [render(files[n], sun, size, config.dem_gsd, seed if n == "with detail" else None) for sun in SUNS_DEG]
            for n in NAMES
        }
    spectra["brightness"] = {
        n: np.mean([spectrum(i / i.mean()) for i in images], axis=0) for n, images in pictures.items()
    }
    area = (1.03 * (size - 2 * BORDER) * config.dem_gsd / 1000) ** 2
    counts = {
        n: [count(i, pictures["whole"][k]) / area for k, i in enumerate(images)] for n, images in pictures.items()
    }
    numbers = {
        "mean_error": float(np.abs(coarsen(detailed, REDUCED) - reduced).max()),
        "sift_per_km2": counts,
        "power_of_whole": {
            kind: {n: in_bands(parts[n], parts["whole"]) for n in NAMES[1:]} for kind, parts in spectra.items()
        },
    }
    return numbers, spectra, {n: images[1] for n, images in pictures.items()}


def make_grid(size: int, gsd: float) -> Grid:
    crs = local_metric_crs(30.0, 20.0, RADIUS)
    return Grid(crs.to_wkt(), Affine(gsd, 0, -size * gsd / 2, 0, -gsd, size * gsd / 2), size, size, RADIUS)


def write(path: Path, elevation: np.ndarray, grid: Grid) -> Path:
    with MapTiff(path, grid, ["elevation"], {}, ["m"]) as tif:
        tif.put(0, 0, elevation[None])
    return path


def render(path: Path, sun: float, size: int, gsd: float, seed: int | None) -> np.ndarray:
    """(n, n) I/F from far above, a pixel of the picture to one of the whole DEM; its border left out."""
    fov = 2 * math.degrees(math.atan(1.03 * size * gsd / 2 / (ALTITUDE + 2600.0)))  # just coarser than the DEM
    pose = {"position": (30.0, 20.0, ALTITUDE), "fov_deg": fov, "size_px": (size, size)}
    with Renderer(path, model="lunar_lambert", samples=2, detail=seed) as renderer:
        frame = renderer.view(pose, {"sun_azimuth_deg": 90.0, "sun_elevation_deg": sun})
    return frame.image[BORDER:-BORDER, BORDER:-BORDER]


def slopes(z: np.ndarray, gsd: float) -> np.ndarray:
    """Slope towards the east, by central differences."""
    return np.gradient(z.astype(float), gsd, axis=1)[BORDER:-BORDER, BORDER:-BORDER]


def spectrum(field: np.ndarray) -> np.ndarray:
    """Mean power by radial frequency, in bins of equal width up to half a cycle a pixel."""
    window = np.outer(*(np.hanning(n) for n in field.shape))
    power = np.abs(np.fft.fft2((field - field.mean()) * window)) ** 2 / (window**2).sum()
    wave = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n) for n in field.shape), indexing="ij"))
    bins = np.minimum((wave * 128).astype(int), 64).ravel()
    return np.bincount(bins, power.ravel())[1:64] / np.bincount(bins)[1:64]


def in_bands(part: np.ndarray, whole: np.ndarray) -> list[float]:
    """Ratio of powers, geometric mean in each band."""
    wave = (np.arange(1, 64) + 0.5) / 128 * 2 * REDUCED  # of the reduced Nyquist frequency
    return [float(np.exp(np.log(part / whole)[(wave >= low) & (wave < high)].mean())) for low, high in BANDS]


def count(image: np.ndarray, reference: np.ndarray) -> int:
    """SIFT features of a picture that is stretched as another one."""
    white = np.percentile(reference, 99.5)
    grey = np.clip(255 * image / white, 0, 255).astype(np.uint8)
    return len(cv2.SIFT_create().detect(grey, None))


def summarise(runs: list[dict]) -> dict:
    """Means over the scenes."""
    mean = lambda values: np.mean(values, axis=0).tolist()  # noqa: E731
    return {
        "scenes": len(runs),
        "suns_deg": list(SUNS_DEG),
        "bands_of_nyquist": [list(band) for band in BANDS],
        "largest_mean_error_m": max(run["mean_error"] for run in runs),
        "sift_per_km2": {n: mean([run["sift_per_km2"][n] for run in runs]) for n in NAMES},
        "power_of_whole": {
            kind: {n: mean([run["power_of_whole"][kind][n] for run in runs]) for n in NAMES[1:]}
            for kind in ("slope", "brightness")
        },
    }


def draw(spectra: dict, pictures: dict, summary: dict, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(12, 8), constrained_layout=True)
    wave = (np.arange(1, 64) + 0.5) / 128 / 2.5
    for axis, kind in zip(axes[0], ("slope", "brightness"), strict=False):
        for name, colour in zip(NAMES, ("black", "tab:red", "tab:blue"), strict=True):
            axis.loglog(wave, spectra[kind][name], color=colour, label=name)
        axis.axvline(0.5 / (2.5 * REDUCED), color="grey", linestyle=":")
        axis.set(title=f"power of {kind}", xlabel="cycles a metre; dotted: Nyquist of the reduced DEM")
        axis.legend()
    for name, colour in zip(NAMES, ("black", "tab:red", "tab:blue"), strict=True):
        axes[0, 2].plot(SUNS_DEG, summary["sift_per_km2"][name], "o-", color=colour, label=name)
    axes[0, 2].set(title="SIFT features per km2", xlabel="elevation of the Sun, deg", ylim=0)
    for axis, name in zip(axes[1], NAMES, strict=True):
        axis.imshow(pictures[name][:256, :256], cmap="gray", vmin=0, vmax=np.percentile(pictures["whole"], 99.5))
        axis.set(title=name, xticks=[], yticks=[])
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
