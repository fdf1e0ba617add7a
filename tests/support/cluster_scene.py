"""The wide stages as commands on the small scene, in one process and in parts, and whether two artefacts hold the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np

LUNARGR = [sys.executable, "-m", "lunargr_cli.main"]
# The same numbers need the same sums: one thread everywhere.
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")}


def environment() -> dict[str, str]:
    return os.environ | ONE_THREAD


def start(arguments, **options) -> subprocess.Popen:
    command = [*LUNARGR, *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment(), **(pipes | options))


def finish(process: subprocess.Popen, timeout: float = 600) -> tuple[int, str]:
    out, err = process.communicate(timeout=timeout)
    return process.returncode, out + err


def lunargr(*arguments) -> tuple[int, str]:
    return finish(start(arguments))


def write_inputs(folder: Path) -> dict[str, Path]:
    """What the stages are run on, all made in one process: files, scene, crops, pairs, checkpoint."""
    import small_scene

    from stages import ingest, project, sample, train

    files = small_scene.write_scene(folder / "files")
    paths = {name: folder / f"{name}.h5" for name in ("scene", "crops", "pairs", "checkpoint")}
    paths |= {"dem": files.dem, "images": files.images}
    ingest.run(files.dem, files.images, paths["scene"], ingest.Config(gsd=20, crop=32))
    sample.run(paths["scene"], paths["crops"], sample.Config(count=90, tile_m=1280, seed=3))
    project.run(paths["crops"], paths["pairs"], project.Config())
    config = train.Config(model="M2", epochs=1, batch=32, widths=(4, 4, 8), device="cpu", precision="fp32", lr=1e-2)
    train.run(paths["pairs"], paths["checkpoint"], config)
    return paths


def stages(paths: dict[str, Path]) -> dict[str, list[object]]:
    """Each wide stage's arguments."""
    return {
        "ingest": ["ingest", paths["dem"], "--images", paths["images"], "--gsd", 20, "--crop", 32],
        "sample": ["sample", paths["scene"], "--count", 90, "--tile-m", 1280, "--seed", 3],
        "project": ["project", paths["crops"]],
        "infer": ["infer", paths["scene"], paths["checkpoint"], "--window", 64, "--device", "cpu"],
        "evaluate": [
            "evaluate",
            paths["pairs"],
            paths["checkpoint"],
            "--batch",
            2,
            "--split",
            "train",
            "--device",
            "cpu",
        ],
    }


def assert_same(first: Path, second: Path) -> None:
    """Every dataset, group by group: shape, type and bytes. Times that a stage measures of itself are no result."""
    with h5py.File(first) as a, h5py.File(second) as b:
        names: list[set[str]] = [set(), set()]
        for file, found in zip((a, b), names, strict=True):
            file.visititems(lambda name, node, found=found: found.add(name) if isinstance(node, h5py.Dataset) else None)
        assert names[0] == names[1]
        for name in sorted(names[0] - {"epoch_seconds"}):
            x, y = a[name][...], b[name][...]
            assert x.dtype == y.dtype and x.shape == y.shape, name
            if name in ("path", "camera"):  # relative to the artefact
                assert [_place(first, v) for v in x] == [_place(second, v) for v in y], name
            elif x.dtype == object:
                assert x.tolist() == y.tolist(), name
            else:
                assert np.ascontiguousarray(x).tobytes() == np.ascontiguousarray(y).tobytes(), name


def _place(artefact: Path, name: bytes) -> str:
    return os.path.realpath(artefact.resolve().parent / os.fsdecode(name)) if name else ""
