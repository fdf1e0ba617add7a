"""Cast shadow and horizon: megapixels per second beside Embree (through Mitsuba), and memory on a 20,000 x 20,000 map.

python tests/validation/benchmarks/bench_light.py                speed and disagreement
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

GSD = 5.0
AZIMUTHS_DEG = (0, 17, 45, 80, 90, 133, 200, 260, 315)


def terrain(n: int, seed: int = 1, tile: int = 2048) -> np.ndarray:
    """Fractal ground with slopes of 0.2 rms at 5 m, tiled and tilted, (n, n) float32, m."""
    size = min(n, tile)
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    frequency[0, 0] = np.inf
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * frequency**-1.8, s=(size, size))
    z *= 0.2 * GSD / np.gradient(z, axis=0).std()
    tiled = np.tile(z.astype(np.float32), (-(-n // size), -(-n // size)))[:n, :n]
    return tiled + np.arange(n, dtype=np.float32) * 0.01


def timed(call, repeats: int = 7) -> float:
    """Least seconds of several calls, which other work on the machine disturbs less, after one that compiles."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def embree(z: np.ndarray):
    """(seconds to build, function that traces one ray per pixel) or None without Mitsuba."""
    try:
        import mitsuba as mi
    except ImportError:
        return None
    mi.set_variant("llvm_ad_rgb")
    height, width = z.shape
    start = time.perf_counter()
    row, col = np.mgrid[:height, :width]
    a = (row * width + col)[:-1, :-1].ravel().astype(np.uint32)
    faces = np.concatenate([np.stack(t, 1) for t in ((a, a + width, a + width + 1), (a, a + width + 1, a + 1))])
    mesh = mi.Mesh("terrain", vertex_count=z.size, face_count=len(faces))
    parameters = mi.traverse(mesh)
    vertices = np.stack([col * GSD, -row * GSD, z], -1).astype(np.float32)
    parameters["vertex_positions"] = mi.Float(vertices.reshape(-1))
    parameters["faces"] = mi.UInt32(faces.ravel())
    parameters.update()
    scene = mi.load_dict({"type": "scene", "terrain": mesh})
    built = time.perf_counter() - start
    origin = mi.Point3f(*(np.ravel(v).astype(np.float32) for v in (col * GSD, -row * GSD, z + 1e-3)))

    def trace(azimuth: float, elevation: float) -> np.ndarray:
        sun = (math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation))
        return np.array(scene.ray_test(mi.Ray3f(origin, mi.Vector3f(*sun)))).reshape(z.shape)

    return built, trace


def speed(size: int, peer_size: int, sun_elevation: float) -> None:
    from stages.physics.horizon import cast_shadow, horizon

    peer = embree(terrain(peer_size))
    small, large = terrain(peer_size), terrain(size)
    print(f"{'azimuth':>8} {'horizon':>9} {'shadow':>9} {'Embree':>9} {'ratio':>8} {'differs':>8}")
    print(f"{'deg':>8} {size:>9} {peer_size:>9} {peer_size:>9} {'shadow':>8} {'%':>8}   Mpx/s")
    ours, theirs = [], []
    for degrees in AZIMUTHS_DEG:
        azimuth = math.radians(degrees)
        big = large.size / 1e6 / timed(lambda a=azimuth: horizon(large, GSD, a))
        mid = small.size / 1e6 / timed(lambda a=azimuth: cast_shadow(small, GSD, a, sun_elevation))
        ours.append(big)
        line = f"{degrees:8d} {big:9.0f} {mid:9.0f}"
        if peer:
            rate = small.size / 1e6 / timed(lambda a=azimuth: peer[1](a, sun_elevation), 2)
            theirs.append(rate)
            differs = (peer[1](azimuth, sun_elevation) != cast_shadow(small, GSD, azimuth, sun_elevation)).mean()
            line += f" {rate:9.1f} {mid / rate:8.0f} {100 * differs:8.3f}"
        print(line, flush=True)
    print(f"horizon {min(ours):.0f}..{max(ours):.0f} Mpx/s", end="")
    print(f"; Embree {statistics.median(theirs):.1f} Mpx/s after {peer[0]:.1f} s of building" if peer else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=8192)
    parser.add_argument("--peer-size", type=int, default=2048)
    parser.add_argument("--azimuth", type=float, default=130.0)
    options = parser.parse_args()
    speed(options.size, options.peer_size, math.radians(8))


if __name__ == "__main__":
    main()
