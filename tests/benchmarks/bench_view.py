"""Frames per second and weight of the page of `lunargr view`, in headless Chromium with software rendering (SwiftShader).

    python tests/benchmarks/bench_view.py [--edge 2048] [--frames 20] [--model M2]

No graphics card takes part: the processor draws, on as many cores as there are. A laptop's GPU is some tens of times faster.
A frame ends when a pixel of it has been read back. "Sun": every frame has another Sun, so that shadows and light are worked
out for every pixel of the map; "camera": the light stays, the view from space turns.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from browser import run_in_page
from relief import hills
from render_scene import make_grid, smooth_maps, write_svbrdf

from stages import view
from stages.physics.photometry import get_model

SCRIPT = """
const gl = document.querySelector("canvas").getContext("webgl2"), pixel = new Uint8Array(4);
const draw = (parts) => { lunargr.set(parts); gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); };
const time = (change) => {
  draw(change(0));
  const seconds = [];
  for (let k = 1; k <= FRAMES; k++) { const start = performance.now(); draw(change(k)); seconds.push((performance.now() - start) / 1000); }
  return seconds.sort((a, b) => a - b)[Math.floor(FRAMES / 2)];
};
const sun = time((k) => ({ azimuth: (7 * k) % 360, elevation: 20 }));
const flat = time((k) => ({ azimuth: (7 * k) % 360, elevation: 20, shadows: false }));
lunargr.set({ view: "space" });
const still = time(() => ({}));
return { sun, flat, still };
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--edge", type=int, default=2048)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--model", default="M2")
    options = parser.parse_args()
    edge, rng = options.edge, np.random.default_rng(1)
    grid = make_grid(edge, edge, 5.0)
    defaults = np.array(list(get_model(options.model).defaults().values()))
    rough = smooth_maps(rng, (edge, edge), len(defaults)) - 0.05 + 0.001 * rng.standard_normal((1, edge, edge))
    with tempfile.TemporaryDirectory() as folder:
        source, page = Path(folder) / "svbrdf.h5", Path(folder) / "view.html"
        write_svbrdf(source, grid, hills(rng, edge, 5.0), defaults[:, None, None] * (1 + 4 * rough), options.model)
        start = time.perf_counter()
        view.run(source, None, page, view.Config())
        print(
            f"{edge} x {edge} px, {options.model}: page of {page.stat().st_size / 1e6:.1f} MB in {time.perf_counter() - start:.1f} s"
        )
        found = run_in_page(page, SCRIPT.replace("FRAMES", str(options.frames)), timeout=1800)
    print(f"SwiftShader on {os.cpu_count()} cores, median of {options.frames} frames:")
    for name, what in (
        ("sun", "another Sun, cast shadows"),
        ("flat", "another Sun, no shadows"),
        ("still", "view from space"),
    ):
        print(f"  {what:26s} {1 / found[name]:7.2f} frames/s ({1000 * found[name]:.0f} ms)")


if __name__ == "__main__":
    main()
