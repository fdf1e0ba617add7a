"""How well `lunargr refine` finds relief that a DEM lacks: simulated scenes with known heights, each through the whole pipeline.

    python tests/validation/refine.py --output results/refine [--case smooth --case smooth:4] [--size 512] [--seed 1 --seed 7]

A third of twelve images is left out of the albedo and of the heights; the other eight, or as many of them as
a case names, make them. Every figure is written to
docs/refine_figures.csv. Beside them stands photoclinometry as ASP's `sfs` states it (Alexandrov & Beyer 2018, Earth Space
Sci. 5, 652): one law, one exposure per image, a smoothness prior, no albedo map; its weight is the best one for the true heights.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import rasterio
import rasterio.warp
from scipy.ndimage import distance_transform_edt, laplace, zoom
from scipy.sparse.linalg import LinearOperator, cg

ROOT = Path(__file__).resolve().parents[2]
CASES = {
    "smooth": "dem_smoothing:sigma2_px2=9",  # DEM px of 2.5 m, the truth's grid
    "smoother": "dem_smoothing:sigma2_px2=30",
    "reduced": "none",  # the DEM reduced 4 times
    "complete": "none",  # the DEM lacks nothing but 5 cm of white noise; all that the map lacks is albedo
}
USED = 8  # of twelve images
SEEDS = (1, 7, 11)  # 1 and 7 were looked at while `refine` was made, 11 was drawn afterwards
ROWS = (*CASES, "smooth:4")
BANDS = ((3, 8), (8, 16), (16, 64))  # px
WEIGHTS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)


def run(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "lunargr_cli.main", *map(str, words), "--quiet"], check=True, cwd=ROOT)


def make(folder: Path, case: str, size: int, images: int, seed: int) -> None:
    """The chain of commands up to the scores; what is there is not made again."""
    f = {n: folder / n for n in ("scene", "scene.h5", "crops.h5", "pairs.h5", "checkpoint.h5", "svbrdf.h5")}
    albedo, refined = folder / f"albedo_{images}.h5", folder / f"refined_{images}.h5"
    if not f["scene"].exists():
        run("simulate", "-o", f["scene"], "--size-px", size, "--images", 12, "--hidden", CASES[case], "--seed", seed)
        if case == "reduced":
            reduce(f["scene"] / "dem.tif", 4)
    with open(f["scene"] / "images.csv") as stream:
        names = [row["image_id"] for k, row in enumerate(csv.DictReader(stream)) if k % 3][images:]
    fewer = ("--leave-out", ",".join(names)) if names else ()
    steps = (
        ("scene.h5", "ingest", f["scene"] / "dem.tif", "--images", f["scene"] / "images.csv", "--gsd", 5),
        ("crops.h5", "sample", f["scene.h5"], "--count", 900, "--split", "50/10/40"),
        ("pairs.h5", "project", f["crops.h5"]),
        ("checkpoint.h5", "train", f["pairs.h5"], "--epochs", 4, "--batch", 8, "--precision", "fp32"),
        ("svbrdf.h5", "infer", f["scene.h5"], f["checkpoint.h5"], "--no-geotiff"),
        (albedo.name, "albedo", f["svbrdf.h5"], f["scene.h5"], "--fold", "1/3", *fewer, "--no-geotiff"),
        (refined.name, "refine", albedo, f["scene.h5"], "--no-geotiff"),
        (f"held_out_{images}.h5", "held-out", f["pairs.h5"], refined),
    )
    for name, *words in steps:
        if not (folder / name).exists():
            run(*words, "-o", folder / name)


def reduce(path: Path, factor: int) -> None:
    """Replace a DEM by its means over squares of pixels, brought back to its grid by cubic splines."""
    with rasterio.open(path, "r+") as file:
        heights, mask = file.read(1), file.read_masks(1) > 0
        filled = heights[tuple(distance_transform_edt(~mask, return_distances=False, return_indices=True))]
        edge = filled.shape[0] // factor
        coarse = filled.reshape(edge, factor, edge, factor).mean(axis=(1, 3))
        file.write(np.where(mask, zoom(coarse, factor, order=3, grid_mode=True, mode="nearest"), heights), 1)


def in_band(values: np.ndarray, known: np.ndarray, band: tuple[float, float]) -> float:
    """rms of a field (H, W) between two wavelengths, px, under a Hann window."""
    height, width = values.shape
    window = np.outer(np.hanning(height), np.hanning(width))
    power = np.abs(np.fft.fft2(np.where(known, values - values[known].mean(), 0) * window)) ** 2
    f = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None])
    return float(np.sqrt(power[(f <= 1 / band[0]) & (f > 1 / band[1])].sum() / (window**2).sum() / values.size))


def score(folder: Path, case: str, used: int) -> dict[str, object]:
    """One row of figures."""
    with h5py.File(folder / "scene/truth.h5") as file:
        truth, level = file["elevation"][...], np.log(file["standard_iof"][...])
    with h5py.File(folder / f"refined_{used}.h5") as file:
        h, std, albedo, albedo_std, alone, elevation = (
            file[n][...] for n in ("elevation_correction", "elevation_std", "albedo", "albedo_std", "albedo_alone", "elevation")
        )  # fmt: skip
        coefficients, names = file["coefficients"][...], file["coefficient_name"].asstr()[...].tolist()
        gain, reason, images = (
            file["refine_gain_percent"][...],
            str(file.attrs["refine_reason"]),
            file["albedo_images"][...],
        )
        model = str(file.attrs["model"])
    dem = elevation - h
    known = np.isfinite(dem) & np.isfinite(truth) & np.isfinite(albedo)
    seen = known & (images > 1)
    row: dict[str, object] = {"case": case, "images": used, "reason": reason}
    row |= {f"gain_{n}": round(float(v), 1) for n, v in zip(("percent", "low", "high"), gain, strict=True)}
    for low, high in BANDS:
        before, after = (in_band(np.where(known, truth - v, 0), known, (low, high)) for v in (dem, elevation))
        row |= {f"before_m_{low}_{high}px": round(before, 4), f"after_m_{low}_{high}px": round(after, 4)}
        row[f"height_error_percent_{low}_{high}px"] = round(100 * (after / before - 1), 1)
    if not reason:
        z = np.abs(truth - elevation)[seen] / std[seen]
        row |= {"coverage_95_height": share(z < 1.96), "coverage_68_height": share(z < 1.0)}
    # the truth's brightness at incidence 30, emission 0, phase 30 over the map's
    ratio = level - np.log(standard_iof(model, dict(zip(names, coefficients, strict=True))))
    away = np.where(seen, np.log(albedo) - ratio, np.nan)
    away -= np.nanmedian(away)
    z = np.abs(away[seen]) / (albedo_std / albedo)[seen]
    row |= {"coverage_95_albedo": share(z < 1.96), "coverage_68_albedo": share(z < 1.0)}
    row["albedo_error"] = round(float(np.nanstd(away)), 4)
    row["albedo_error_alone"] = round(float(np.std((np.log(alone) - ratio)[seen])), 4)
    with open(folder / f"held_out_{used}.json") as stream:
        result = json.load(stream)
    models = ("terrain", "albedo", "refined", "albedo_gain_offset", "refined_gain_offset")
    mse = {n: result["models"][n]["mse"] for n in models}
    row |= {f"mse_{n}": f"{v:.4g}" for n, v in mse.items()}
    row["mse_percent"] = round(100 * (mse["refined"] / mse["albedo"] - 1), 1)
    found = result["gains"]["refined"]["albedo"]
    row |= {f"mse_gain_{k}": round(found[f"gain_percent_{k}"], 1) for k in ("low", "high")}
    if (
        case == "complete"
    ):  # as if the heights were all false: their shading under a Sun at 45 deg over the albedo's contrast
        east = (h[:, 2:] - h[:, :-2])[known[:, 1:-1]] / 10.0
        row["relief_from_albedo_percent"] = round(float(100 * np.nanstd(east) / np.std(np.log(alone)[seen])), 2)
    return row


def share(held: np.ndarray) -> float:
    return round(100 * float(held.mean()), 1)


def standard_iof(model: str, values: dict[str, np.ndarray]) -> np.ndarray:
    from stages.physics.photometry import evaluate

    angle = np.radians(30.0)
    return np.asarray(evaluate(model, values, angle, 0.0, angle))


def photoclinometry(folder: Path) -> dict[str, object]:
    """Height errors of one law with a smoothness prior, from the same images."""
    with h5py.File(folder / "scene/truth.h5") as file:
        truth, used = file["elevation"][...], [k for k in range(12) if k % 3]
        angles = [
            np.radians(file[n][...]) for n in ("incidence_deg", "sun_azimuth_deg", "emission_deg", "camera_azimuth_deg")
        ]
    with h5py.File(folder / f"refined_{USED}.h5") as file:
        dem = file["elevation"][...] - file["elevation_correction"][...]
    known = np.isfinite(dem) & np.isfinite(truth)
    ground = np.where(known, dem, dem[known].mean()).astype(float)
    images = [resampled(folder, k, dem.shape) for k in used]
    vectors = [[direction(angles[0][k], angles[1][k]), direction(angles[2][k], angles[3][k])] for k in used]
    tried = [h for h in (solve(ground, images, vectors, w) for w in WEIGHTS) if np.isfinite(h).all()]
    best = min(tried, key=lambda h: in_band(truth - ground - h, known, (3, 8)))
    return {
        f"photoclinometry_percent_{low}_{high}px": round(
            100 * (in_band(truth - ground - best, known, (low, high)) / in_band(truth - ground, known, (low, high)) - 1), 1
        )
        for low, high in BANDS
    }  # fmt: skip


def direction(zenith: float, azimuth: float) -> np.ndarray:
    return np.array([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)])


def resampled(folder: Path, k: int, shape: tuple[int, int]) -> np.ndarray:
    """Image k on the scene's grid, NaN where it shows nothing."""
    with h5py.File(folder / "scene.h5") as file:
        path = folder / str(file["path"].asstr()[k])
        transform = [float(v) for v in str(file["crs"].attrs["GeoTransform"]).split()]
        crs = str(file["crs"].attrs["crs_wkt"])
    target = np.full(shape, np.nan, np.float32)
    with rasterio.open(path) as image:
        rasterio.warp.reproject(
            rasterio.band(image, 1), target, dst_transform=rasterio.Affine.from_gdal(*transform), dst_crs=crs, dst_nodata=np.nan,
            resampling=rasterio.warp.Resampling.average,
        )  # fmt: skip
    return target.astype(float)


def shade(east: np.ndarray, north: np.ndarray, sun: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Lunar-Lambert with McEwen's (1996) L by phase, 0 where the Sun is down."""
    g = np.degrees(np.arccos(np.clip(sun @ camera, -1, 1)))
    part = 1 - 0.019 * g + 2.42e-4 * g**2 - 1.46e-6 * g**3
    length = np.sqrt(1 + east**2 + north**2)
    mu0, mu = ((v[2] - east * v[0] - north * v[1]) / length for v in (sun, camera))
    return np.where(mu0 > 0, 2 * part * mu0 / np.maximum(mu0 + mu, 0.05) + (1 - part) * mu0, 0)


def solve(ground: np.ndarray, images: list[np.ndarray], vectors: list, weight: float, gsd: float = 5.0) -> np.ndarray:
    """Heights beyond ``ground`` by Gauss-Newton steps of least squares of images and of the correction's Laplacian."""
    h = np.zeros_like(ground)
    for _ in range(3):
        north, east = np.gradient(ground + h, gsd)
        terms = []
        for image, (sun, camera) in zip(images, vectors, strict=True):
            bright = shade(east, -north, sun, camera)
            use = np.isfinite(image) & (bright > 0.02)
            exposure = (image * bright)[use].sum() / (bright[use] ** 2).sum()
            level = exposure * bright[use].mean()
            slopes = [
                exposure * (shade(east + a, -north + b, sun, camera) - bright) / 1e-3 for a, b in ((1e-3, 0), (0, 1e-3))
            ]
            terms.append([np.where(use, v / level, 0) for v in (image - exposure * bright, *slopes)])

        def normal(flat: np.ndarray, terms: list = terms, h: np.ndarray = h) -> np.ndarray:
            x = flat.reshape(h.shape)
            down, right = np.gradient(x, gsd)
            seen = [p * right - q * down for _, p, q in terms]
            return (back(terms, seen, gsd) + weight * laplace(laplace(x))).ravel()

        right = back(terms, [e for e, _, _ in terms], gsd) - weight * laplace(laplace(h))
        step, _ = cg(LinearOperator((h.size, h.size), normal, dtype=float), right.ravel(), rtol=1e-3, maxiter=200)
        h = h + step.reshape(h.shape)
    return h


def back(terms: list, values: list[np.ndarray], gsd: float) -> np.ndarray:
    """The transpose of what slopes do to the images."""
    east = sum(p * v for (_, p, _), v in zip(terms, values, strict=True))
    north = sum(q * v for (_, _, q), v in zip(terms, values, strict=True))
    return -np.gradient(east, gsd, axis=1) + np.gradient(north, gsd, axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=ROOT / "results/refine")
    parser.add_argument("--case", choices=ROWS, action="append", help="and the number of images that make the heights")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--seed", type=int, action="append", help="of the scenes")
    parser.add_argument("--docs", type=Path, help="CSV to write the rows into")
    options = parser.parse_args()
    rows = []
    for row, seed in product(options.case or ROWS, options.seed or SEEDS):
        case, _, number = row.partition(":")
        images = int(number or USED)
        folder = (options.output / f"{case}_{seed}").resolve()
        folder.mkdir(parents=True, exist_ok=True)
        make(folder, case, options.size, images, seed)
        beside = photoclinometry(folder) if case != "complete" and images == USED else {}
        rows.append({"seed": seed} | score(folder, case, images) | beside)
        print(json.dumps(rows[-1], indent=1), flush=True)
    if options.docs:
        columns = list(dict.fromkeys(name for row in rows for name in row))
        with open(options.docs, "w", newline="") as stream:
            writer = csv.DictWriter(stream, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
