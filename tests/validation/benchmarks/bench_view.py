"""The page of `lunargr view` in headless Chromium: its weight, its I/F against `lunargr render`, its frames per second.

    python tests/validation/benchmarks/bench_view.py                     # a rough map of 2048 x 2048 px, M2
    python tests/validation/benchmarks/bench_view.py --map demo-full/svbrdf_albedo.h5 --pairs demo-full/pairs.h5

Chromium draws in software (SwiftShader): no graphics card takes part, the processor draws on as many cores as there are. A frame ends
when a pixel of it has been read back. "Another Sun": shadows and light are worked out for every pixel of the map; "camera": light
that goes to it, in space. "While moving": of the coarse map that the page draws until nothing moves.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "support"))

from browser import run_in_page
from relief import hills
from render_scene import make_grid, smooth_maps, write_svbrdf

from stages import render, view
from stages.physics.photometry import get_model
from stages.render.pictures import read_exr

EDGE, MODEL = 2048, "M2"
SUNS = ((270.0, 25.0), (45.0, 45.0), (330.0, 70.0), (200.0, 10.0), (90.0, 5.0), (123.0, 2.0))
FRAMES = """
const median = (...given) => [...Array(COUNT)].map(() => lunargr.rate(1, ...given)).sort((a, b) => a - b)[Math.floor(COUNT / 2)];
const rates = { "another Sun": median("sun"), "another Sun, while moving": median("sun", true) };
lunargr.set({ view: "space" });
return { ...rates, "camera": median("camera"), "camera, while moving": median("camera", true) };
"""


def rough_map(path: Path) -> Path:
    """A worst case for packing: coefficients with noise in every pixel."""
    rng, grid = np.random.default_rng(1), make_grid(EDGE, EDGE, 5.0)
    defaults = np.array(list(get_model(MODEL).defaults().values()))
    rough = smooth_maps(rng, (EDGE, EDGE), len(defaults)) - 0.05 + 0.001 * rng.standard_normal((1, EDGE, EDGE))
    return write_svbrdf(path, grid, hills(rng, EDGE, 5.0), defaults[:, None, None] * (1 + 4 * rough), MODEL)


def against_render(source: Path, page: Path, folder: Path) -> None:
    """The page's I/F beside the command's for some Suns."""
    print(
        "Sun (azimuth, elevation)   mean I/F of the page over render's, less 1   pixels off by more than 1 % of the mean"
    )
    for number, (azimuth, elevation) in enumerate(SUNS):
        found = run_in_page(
            page, f"return lunargr.pixels({{azimuth: {azimuth}, elevation: {elevation}}})", timeout=1800
        )
        config = render.Config(sun_azimuth_deg=azimuth, sun_elevation_deg=elevation)
        render.run(source, folder / f"{number}.exr", config)
        image = read_exr(folder / f"{number}.exr")["image"]
        expected = np.where(np.isfinite(image), np.maximum(image, 0), np.nan)
        mean, off = np.nanmean(expected), np.abs(found.reshape(expected.shape) - expected)
        share = 100 * float((off > 0.01 * mean).sum() / np.isfinite(expected).sum())
        difference = 100 * (np.nanmean(found) / mean - 1)
        print(f"{azimuth:12.0f}, {elevation:4.0f} deg {difference:+38.4f} % {share:42.1f} %", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, help="svbrdf.h5 (default: a rough map made for this)")
    parser.add_argument("--pairs", type=Path, help="photographs for the page")
    parser.add_argument("--frames", type=int, default=11)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, page = options.map or rough_map(folder / "svbrdf.h5"), folder / "view.html"
        start = time.perf_counter()
        made = view.run(source, options.pairs, page, view.Config())
        size = f"page of {made.size / 1e6:.1f} MB in {time.perf_counter() - start:.1f} s"
        print(f"{made.width:,} x {made.height:,} px, {made.model}, {made.photographs} photographs: {size}", flush=True)
        against_render(source, page, folder)
        rates = run_in_page(page, FRAMES.replace("COUNT", str(options.frames)), timeout=1800)
    print(
        f"software rendering (SwiftShader) on {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, median of {options.frames} frames:"
    )
    for words, rate in rates.items():
        print(f"  {words:26s} {rate:6.2f} frames/s")


if __name__ == "__main__":
    main()
