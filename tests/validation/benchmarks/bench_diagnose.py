"""Time of `lunargr diagnose` from open file to answer, against the time NumPy needs to read and sum the same pixels.

python tests/validation/benchmarks/bench_diagnose.py [--size 128]
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hidden.scene import Layout, Scene, Truth, write_pairs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--sites", type=int, default=4)
    options = parser.parse_args()
    import torch

    from stages import diagnose

    torch.set_num_threads(2)
    layout = Layout(seed=3, sites=options.sites + 1, images=options.images, size=options.size)
    scene = Scene(layout)
    print("| hidden | pairs | verdict | seconds | times reading | peak MB |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for effect in ({}, {"phase_slope": {"per_radian": 0.08}}):
            path = write_pairs(Path(folder) / "pairs.h5", scene.make(Truth(effect=effect), 1), layout)
            started = time.perf_counter()
            with h5py.File(path) as file:
                float(sum(np.float64(file["image"][k]).sum() for k in range(len(file["image"]))))
            reading = time.perf_counter() - started
            started = time.perf_counter()
            answer = diagnose.run(path).answer
            seconds = time.perf_counter() - started
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            name = next(iter(effect), "nothing")
            print(
                f"| {name} | {answer.pairs} | {answer.verdict} | {seconds:.1f} | {seconds / reading:.0f} | {peak:.0f} |"
            )


if __name__ == "__main__":
    main()
