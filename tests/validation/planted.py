"""`make campaign-real`: effects planted into real photographs, or into what is known of them, and what `diagnose` makes of it.

    python tests/validation/planted.py --output results/planted --raw stack.h5 --registered registered.h5 --seed 5

A plant changes the images themselves (a shift, a blur, gamma, columns, an echo, clipping), the table (the Sun) or the DEM (smoothed, stretched), in a
copy of pairs that `lunargr project` wrote. Without photographs, :func:`semi_real` makes a scene: measured or fractal relief, rendered four times finer than
the pairs, with drifting reflectance and noise of each image's own. Nothing here imports the forward model.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.ndimage import gaussian_filter, shift

from schemas.packing import pack, read

sys.path.insert(0, str(Path(__file__).parent))

DEVELOPMENT = (1, 2, 3)  # seeds that the method was looked at with; others are for reports


def _images(file: h5py.File, change: Callable[[np.ndarray, int], np.ndarray]) -> None:
    data = read(file["image"], ...).astype(float)
    frames = file["image_index"][...]
    for k in range(len(data)):
        good = np.isfinite(data[k]) & (file["valid"][k] > 0)
        whole = np.where(good, data[k], np.nanmedian(data[k]) if good.any() else 0.0)
        data[k] = np.where(good, change(whole, int(frames[k])), data[k])
    file["image"][...] = pack(file["image"], data)


def moved(file: h5py.File, frame: int, east: float, south: float) -> None:
    """One frame shows ground further east and south by so many pixels."""
    _images(file, lambda x, f: shift(x, (-south, -east), order=3, mode="nearest") if f == frame else x)
    valid = file["valid"][...]
    for k in np.flatnonzero(file["image_index"][...] == frame):
        valid[k] = shift(valid[k].astype(float), (-south, -east), order=1, mode="constant") > 0.99
    file["valid"][...] = valid


def turned_sun(file: h5py.File, azimuth_deg: float, elevation_deg: float = 0.0) -> None:
    """The table's Sun is wrong: truth minus given is the argument."""
    sun = file["sun_direction_enu"][...]
    azimuth = np.arctan2(sun[:, 0], sun[:, 1]) - np.radians(azimuth_deg)
    elevation = np.arcsin(sun[:, 2]) - np.radians(elevation_deg)
    file["sun_direction_enu"][...] = np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], 1
    )


def _elevation(file: h5py.File, change: Callable[[np.ndarray], np.ndarray]) -> None:
    z = read(file["elevation"], ...)
    file["elevation"][...] = pack(file["elevation"], np.stack([change(x) for x in z]))


PLANTS: dict[str, dict[str, Any]] = {
    "shift of one frame by 3 px": {
        "do": lambda f: moved(f, 0, 3.0, 0.0),
        "effect": "misregistration",
        "moved": (0, 3.0, 0.0),
    },
    "shift of one frame by 1.5 px": {
        "do": lambda f: moved(f, 1, -1.0, 1.1),
        "effect": "misregistration",
        "moved": (1, -1.0, 1.1),
    },
    "Sun turned by 10 deg": {"do": lambda f: turned_sun(f, 10.0), "effect": "sun_azimuth", "is": ("error_deg", 10.0)},
    "Sun turned by -5 deg": {"do": lambda f: turned_sun(f, -5.0), "effect": "sun_azimuth", "is": ("error_deg", -5.0)},
    "DEM smoothed by 1.5 px": {
        "do": lambda f: _elevation(f, lambda z: gaussian_filter(z, 1.5, mode="nearest")),
        "effect": "dem_smoothing",
        "is": ("sigma2_px2", 2.25),
    },
    "DEM stretched by 1.2": {
        "do": lambda f: _elevation(f, lambda z: z.mean() + 1.2 * (z - z.mean())),
        "effect": "dem_scale",
        "is": ("relative", 1 / 1.2 - 1),
    },
    "blur of 1.2 px": {
        "do": lambda f: _images(f, lambda x, _: gaussian_filter(x, 1.2, mode="nearest")),
        "effect": "psf_blur",
        "is": ("sigma2_px2", 1.44),
    },
    "gamma 0.8": {
        "do": lambda f: _images(f, lambda x, _: np.clip(x, 1e-9, None) ** 0.8 * np.median(x[x > 0]) ** 0.2),
        "effect": "nonlinearity",
    },
    "columns of 3 %": {
        "do": lambda f: _images(
            f, lambda x, _: x * (1 + 0.03 * np.sqrt(2) * np.cos(np.pi * 3 * (np.arange(x.shape[1]) + 0.5) / x.shape[1]))
        ),
        "effect": "column_pattern",
    },
    "film that varies by 4 %": {"do": lambda f: _developed(f, 0.04), "effect": "frame_field", "is": ("rms", 0.04)},
    "echo of 10 % at 6 px": {
        "do": lambda f: _images(f, lambda x, _: x + 0.1 * shift(x, (0, 6), order=1, mode="nearest")),
        "effect": "echo",
        "is": ("fraction", 0.1),
    },
    "clipped at the 90th percentile": {
        "do": lambda f: _clip(f, 90),
        "effect": "saturation",
    },
}


def _developed(file: h5py.File, rms: float) -> None:
    """Every crop of a frame has a broad wave of its own, 1.5 to 3 crops long, with this rms in the crop."""
    rng = np.random.default_rng(17)

    def wave(x: np.ndarray, _: int) -> np.ndarray:
        rows, columns = np.indices(x.shape) / x.shape[0]
        angle, phase, cycles = *rng.uniform(0, 2 * np.pi, 2), rng.uniform(1 / 3, 2 / 3)
        field = np.cos(2 * np.pi * cycles * (columns * np.cos(angle) + rows * np.sin(angle)) + phase)
        return x * (1 + rms * (field - field.mean()) / field.std())

    _images(file, wave)


def _clip(file: h5py.File, percent: float) -> None:
    level = float(np.nanpercentile(file["image"][...], percent))
    _images(file, lambda x, _: np.minimum(x, level))


def plant(source: Path, target: Path, name: str) -> Path:
    """A copy of the pairs with the plant in it."""
    shutil.copyfile(source, target)
    with h5py.File(target, "a") as file:
        PLANTS[name]["do"](file)
    return target


def resample(source: Path, target: Path, seed: int) -> Path:
    """Unplanted photographs once more: a random half of the places, mirrored or not at random is not done, since light has a side."""
    rng = np.random.default_rng(seed)
    with h5py.File(source) as file:
        site = file["site"][...]
        places = np.unique(site)
        chosen = rng.permutation(places)[: max(3, int(0.7 * len(places)))]
        keep = np.flatnonzero(np.isin(site, chosen))
        with h5py.File(target, "w") as out:
            for key, value in file.attrs.items():
                out.attrs[key] = value
            for name, data in file.items():
                if not isinstance(data, h5py.Dataset) or name in ("pair", "y", "x", "enu", "frame"):
                    continue
                by_pair = data.shape and data.shape[0] == len(site)
                made = out.create_dataset(name, data=data[...][keep] if by_pair else data[...], dtype=data.dtype)
                for key, value in data.attrs.items():
                    if key not in (
                        "DIMENSION_LIST",
                        "REFERENCE_LIST",
                        "CLASS",
                        "NAME",
                        "_Netcdf4Dimid",
                        "_Netcdf4Coordinates",
                    ):
                        made.attrs[key] = value
    return target


def _noise(rng: np.random.Generator, shape: tuple[int, ...], width: float) -> np.ndarray:
    x = gaussian_filter(rng.normal(size=shape), width, mode="wrap")
    return x / x.std()


def fractal(rng: np.random.Generator, size: int, slope: float, cell: float) -> np.ndarray:
    """Self-affine relief with a given rms slope, as tangent, at four cells."""
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    k[0, 0] = 1.0
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * k**-1.9 * (k > 2.0 / size), s=(size, size))
    coarse = gaussian_filter(z, 2.0, mode="wrap")
    gy, gx = np.gradient(coarse, cell)
    return coarse * slope / np.sqrt((gx**2 + gy**2).mean())


def semi_real(
    target: Path,
    seed: int,
    sites: int = 4,
    images: int = 8,
    size: int = 64,
    relief: np.ndarray | None = None,
    truth: dict[str, float] | None = None,
) -> Path:
    """Pairs of a scene made here: lunar-Lambert ground on a fine grid, drifting reflectance, each image's own broad noise.

    relief : heights in m that places are cut from; None for a fractal. truth : sun_azimuth_deg, blur_px, dem_scale, dem_smooth_px,
    phase_slope, shift_px (of image 0), noise (broad, relative)
    """
    truth = truth or {}
    rng = np.random.default_rng(seed)
    fine, gsd = 4, 20.0
    side = size * fine
    frames = [
        (rng.uniform(0, 360), rng.uniform(25, 60), rng.uniform(0, 360), rng.uniform(0, 25)) for _ in range(images)
    ]
    keys = (
        "image",
        "elevation",
        "sun_horizon_deg",
        "sun_direction_enu",
        "camera_position_enu",
        "image_index",
        "site",
        "split",
    )
    rows: dict[str, list[Any]] = {k: [] for k in keys}
    amount, width = truth.get("noise", rng.uniform(0.002, 0.02)), rng.uniform(4, 16)
    for place in range(sites + 1):
        z = fractal(rng, side, 0.12, gsd / fine) if relief is None else _cut(rng, relief, side, gsd / fine)
        albedo = 0.08 * (1 + 0.05 * _noise(rng, (side, side), 40) + 0.02 * _noise(rng, (side, side), 4))
        drift = 0.1 * _noise(rng, (side, side), 60)  # of the phase function
        north, east = np.gradient(z, gsd / fine)
        normal = np.stack([-east, north, np.ones_like(z)])  # rows run south
        normal /= np.sqrt((normal**2).sum(0))
        coarse = z.reshape(size, fine, size, fine).mean((1, 3))
        given = coarse + 0.1 * gsd * 0.03 * _noise(rng, coarse.shape, 1.5)
        given = given.mean() + (given - given.mean()) / (1 + truth.get("dem_scale", 0.0))
        if truth.get("dem_smooth_px"):
            given = gaussian_filter(given, truth["dem_smooth_px"], mode="nearest")
        for k, (azimuth, elevation, view_azimuth, emission) in enumerate(frames):
            sun = _unit(azimuth + truth.get("sun_azimuth_deg", 0.0), elevation)
            view = _unit(view_azimuth, 90 - emission)
            mu0, mu = (np.clip(np.tensordot(v, normal, 1), 1e-3, None) for v in (sun, view))
            g = np.arccos(np.clip(sun @ view, -1, 1))
            law = 0.6 * 2 * mu0 / (mu0 + mu) + 0.4 * mu0
            radiance = albedo * law * np.exp(-(0.4 + truth.get("phase_slope", 0.0) + drift) * g)
            image = gaussian_filter(radiance, fine * (0.45**2 + truth.get("blur_px", 0.0) ** 2) ** 0.5, mode="nearest")
            offset = rng.normal(0, 0.1, 2) + (np.array([0.0, truth.get("shift_px", 0.0)]) if k == 0 else 0.0)
            image = shift(image, -offset * fine, order=1, mode="nearest").reshape(size, fine, size, fine).mean((1, 3))
            image *= 1 + amount * _noise(rng, image.shape, width)
            image += image.mean() / rng.uniform(60, 140) * rng.normal(size=image.shape)
            rows["image"].append(image)
            rows["elevation"].append(given)
            rows["sun_horizon_deg"].append(np.full_like(given, -10.0))
            rows["sun_direction_enu"].append(_unit(azimuth, elevation))
            rows["camera_position_enu"].append(view * 400 * size * gsd)
            rows["image_index"].append(k)
            rows["site"].append(place)
            rows["split"].append(2 if place == sites else 0)
    return _write(target, {k: np.asarray(v) for k, v in rows.items()}, images, size, gsd)


def _cut(rng: np.random.Generator, relief: np.ndarray, side: int, cell: float) -> np.ndarray:
    """A piece of measured relief, stretched to rms slopes of 7 deg at this cell."""
    from scipy.ndimage import zoom

    need = side // 4 + 2
    row, column = (int(rng.integers(0, n - need)) for n in relief.shape)
    z = zoom(relief[row : row + need, column : column + need].astype(float), 4, order=3)[:side, :side]
    gy, gx = np.gradient(gaussian_filter(z, 2.0), cell)
    return (z - z.mean()) * 0.12 / np.sqrt((gx**2 + gy**2).mean())


def _unit(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])


def _write(path: Path, data: dict[str, np.ndarray], images: int, size: int, gsd: float) -> Path:
    from hidden.scene import Layout, write_pairs

    n = len(data["site"])
    y, x = np.mgrid[:size, :size].astype(float)
    data["detector_sample"], data["detector_line"] = (np.broadcast_to(v, (n, size, size)) for v in (x, y))
    data["valid"] = np.ones((n, size, size), bool)
    return write_pairs(path, data, Layout(sites=int(data["site"].max()), images=images, size=size, gsd=gsd))


def shifts(answer: Any) -> list[list[float]]:
    """[east, south] px of every frame, as a diagnosis names them; [] where it names none."""
    for cause in answer.causes:
        if cause.effect.name == "misregistration":
            return np.stack([np.asarray(cause.effect.values[k]) for k in ("east_px", "south_px")], 1).tolist()
    return []


def judge(path: Path, name: str | None) -> dict[str, Any]:
    """What `diagnose` says of a file, beside what was planted."""
    from stages import diagnose

    started = time.process_time()
    answer = diagnose.run(path).answer
    said = answer.to_json()
    return {
        "shifts": shifts(answer),
        "planted": name,
        "effect": PLANTS[name]["effect"] if name else None,
        "cpu_s": time.process_time() - started,
        "said": said,
    }


def _values(cause: dict[str, Any]) -> str:
    every = cause["parameters"].items()
    return ", ".join(f"{k} {p['value']:.3g} +- {p['error'] or 0:.2g}" for k, p in every)


def report(cases: list[dict[str, Any]]) -> str:
    """Counts and a row per case, in Markdown."""
    whole = {c["source"]: c["shifts"] for c in cases if c.get("whole")}
    lines = ["| planted | named | gain on held-out ground, % |", "|---|---|---|"]
    first = group = planted = false = unplanted = 0
    natural = set()
    for c in cases:
        if c["planted"] is None and c.get("whole"):
            natural |= {x["effect"] for x in c["said"]["causes"]}
    for c in cases:
        causes = c["said"]["causes"]
        named = "; ".join(f"{x['effect']} ({_values(x)})" for x in causes)
        shares = [x["held_out_gain_percent"] for x in causes]
        gains = "; ".join("-" if g is None else f"{g:.1f}" for g in shares)
        if c["planted"]:
            planted += 1
            new = [x for x in causes if x["effect"] not in natural or x["effect"] == c["effect"]]
            moved_by = PLANTS[c["planted"]].get("moved")
            if moved_by and new and new[0]["effect"] == c["effect"]:  # beside the shift that the frame has anyway
                frame, *planted_px = moved_by
                change = np.array(c["shifts"][frame]) - (whole[c["source"]] or np.zeros_like(c["shifts"]))[frame]
                named += f"; this frame changes by {change[0]:.2f}, {change[1]:.2f} px"
                if np.hypot(*(change - planted_px)) > 0.3 * np.hypot(*planted_px):
                    new = []
            first += bool(new) and new[0]["effect"] == c["effect"]
            group += any(c["effect"] in x["group"] for x in new)
        elif not c.get("whole"):
            unplanted += 1
            false += any(x["effect"] not in natural for x in causes)
        lines.append(f"| {c['planted'] or 'nothing'} | {named or c['said']['verdict']} | {gains} |")
    head = [
        f"- planted cause first: {first} of {planted}; within a group: {group} of {planted}",
        f"- unplanted resamples with a name that the whole set has not: {false} of {unplanted}",
        "",
    ]
    return "\n".join(head + lines) + "\n"


def case(source: Path, name: str | None, seed: int | None) -> dict[str, Any]:
    """A file as it is, with something planted, or with its pieces of ground drawn again."""
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "pairs.h5"
        if name:
            return judge(plant(source, made, name), name) | {"source": source.name}
        if seed is not None:
            return judge(resample(source, made, seed), None) | {"source": source.name}
        return judge(source, None) | {"whole": True, "source": source.name}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--raw", type=Path, required=True)
    parser.add_argument("--registered", type=Path)
    parser.add_argument("--resamples", type=int, default=40)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--output", type=Path, required=True)
    a = parser.parse_args()
    asked: list[tuple[Path, str | None, int | None]] = []
    for source in [p for p in (a.raw, a.registered) if p]:
        asked += [(source, None, None), *((source, name, None) for name in PLANTS)]
        asked += [(source, None, 1000 * a.seed + k) for k in range(a.resamples)]
    a.output.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(a.jobs, multiprocessing.get_context("spawn")) as pool:
        cases = []
        for made in pool.map(case, *zip(*asked, strict=True)):
            cases.append(made)
            a.output.with_suffix(".json").write_text(json.dumps(cases, indent=1))
            a.output.with_suffix(".md").write_text(report(cases))
    print(report(cases))


if __name__ == "__main__":
    main()
