"""Speed of the cameras: line-scan ground_to_image against a numpy Newton search in the same run, and orthorectification.

    python tests/validation/benchmarks/bench_cameras.py [ISD.json ...]

Without an ISD the cameras of the reference data are taken (LUNARGR_SHARED, or ../shared).
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numba
import numpy as np
from rasterio.transform import Affine

from stages.physics.cameras import open_camera
from stages.physics.cameras.linescan import LineScan
from stages.physics.images.orthorectify import Terrain, orthorectify
from stages.physics.maps.grid import Grid, local_metric_crs

SHARED = Path(os.environ.get("LUNARGR_SHARED", Path(__file__).resolve().parents[4] / "shared"))
POINTS = 1_000_000


def numpy_search(camera: LineScan, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The peer: secant steps on whole arrays, with the same tables and detector."""

    def row(line):
        times = camera.times(line)
        looks = np.einsum("nij,ni->nj", camera.rotations(times), points - camera.positions.at(times))
        place = camera.detector.places(looks)
        return place[0], place[1]

    before, line = np.full(len(points), camera.lines * 0.45), np.full(len(points), camera.lines * 0.55)
    miss_before = row(before)[0]
    for _ in range(12):
        miss, sample = row(line)
        if np.abs(miss).max() < 1e-7:
            break
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(miss != miss_before, miss * (line - before) / (miss - miss_before), 0)
        before, miss_before, line = line, miss, line - step
    return line, sample


def best(function, repeats=3):
    times = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        function()
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    return min(times)


def main() -> None:
    names = [Path(p) for p in sys.argv[1:]] or sorted((SHARED / "oracles").glob("*roc*M103*.isd.json")) + sorted(
        (SHARED / "oracles").glob("*ough*Nac*.isd.json")
    )
    print(f"{numba.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}")
    print(f"{'camera':<40}{'points':>10}{'M points/s':>12}{'per core':>10}{'numpy':>8}{'ratio':>8}{'max err px':>12}")
    for path in names:
        camera = open_camera(path)
        side = int(POINTS**0.5)
        line, sample = (
            v.ravel()
            for v in np.meshgrid(
                np.linspace(0, camera.lines, side), np.linspace(0, camera.samples, side), indexing="ij"
            )
        )
        points = camera.image_to_ground(line, sample, 500 * np.sin(line / 300) * np.cos(sample / 400))
        camera.ground_to_image(points[:10])  # compile
        wall, cpu = best(lambda c=camera, p=points: c.ground_to_image(p))
        few = points[:: len(points) // 50_000]
        peer, _ = best(lambda c=camera, p=few: numpy_search(c, p), 1)
        found = camera.ground_to_image(points)
        error = max(np.abs(found[0] - line).max(), np.abs(found[1] - sample).max())
        rate, peer_rate = len(points) / wall / 1e6, len(few) / peer / 1e6
        print(
            f"{path.name:<40}{len(points):>10}{rate:>12.2f}{len(points) / cpu / 1e6:>10.2f}{peer_rate:>8.3f}"
            f"{rate / peer_rate:>8.0f}{error:>12.1e}"
        )
        _ortho(camera)


def _ortho(camera: LineScan) -> None:
    """Ground pixels per second of a crop in the middle of the image, and the largest window of the image held at once."""
    middle = camera.image_to_ground(camera.lines / 2, camera.samples / 2)
    lat = np.degrees(np.arcsin(middle[2] / np.linalg.norm(middle)))
    lon = np.degrees(np.arctan2(middle[1], middle[0]))
    grid = Grid(local_metric_crs(lon, lat, 1737400.0).to_wkt(), Affine(4, 0, -512, 0, -4, 512), 256, 256, 1737400.0)
    terrain = Terrain(20 * np.random.default_rng(0).random((256, 256)), grid)
    held = [0]

    def read_window(line, sample, lines, samples):
        held[0] = max(held[0], lines * samples)
        return np.ones((lines, samples), np.float32)

    orthorectify(read_window, camera, terrain, (0, 0, 256, 256))
    wall, _ = best(lambda: orthorectify(read_window, camera, terrain, (0, 0, 256, 256)))
    print(
        f"  orthorectify 256 x 256 px: {256 * 256 / wall / 1e3:.0f} k ground px/s, at most {held[0] / 1e6:.1f} M image px held"
    )


if __name__ == "__main__":
    main()
