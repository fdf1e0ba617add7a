"""Interrupt every stage at random moments, run it again, and compare every dataset with an uninterrupted run's.

    python tests/validation/endurance.py [--times 20] [--stages ingest,train,...] [--seed 0]

Each time: the command is started, ended by SIGINT or SIGKILL at a random moment of its run, and (sometimes after a
second interruption) run again with the same words. What is at the output's name while it was interrupted must be
nothing, or whole. Wide stages are tried with --resume (finished parts are used again) and, every fourth time, without
(they start anew). Ends with exit code 1 where any byte differs, or anything is left beside the output.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
import numpy as np
import OpenImageIO as oiio
import rasterio
from cluster_scene import assert_same, finish, lunargr, stages, start, write_inputs

from schemas import open_artefact, read_kind

RESUMABLE = {"ingest": 3, "project": 6, "infer": 4, "evaluate": None, "train": None}


def commands(paths: dict[str, Path]) -> dict[str, list[object]]:
    """Every stage's arguments on the small scene."""
    train = ["train", paths["pairs"], "--epochs", 2, "--batch", 16, "--widths", "4-4-8", "--device", "cpu"]
    diagnose = ["diagnose", paths["pairs"], "--pairs", 40, "--causes", 1]
    render = ["render", paths["svbrdf"], "--sun-azimuth", 270, "--sun-elevation", 30]
    return stages(paths) | {"train": [*train, "--precision", "fp32"], "diagnose": diagnose, "render": render}


def output_of(folder: Path, name: str) -> Path:
    return folder / ("render.exr" if name == "render" else f"{name}.h5")


def with_resume(name: str, command: list[object], resume: bool) -> list[object]:
    if not resume or name not in RESUMABLE:
        return command
    parts = RESUMABLE[name]
    return [*command, "--resume", *(["--parts", parts] if parts else [])]


def interrupt(command: list[object], output: Path, how: int, after: float) -> bool:
    """Whether the run was still going when it was stopped."""
    process = start(command)
    time.sleep(after)
    alive = process.poll() is None
    if alive:
        process.send_signal(how)
    _, said = finish(process)
    if "Traceback" in said and "lunargr" in said:  # and not one of Python's own, before it has read a line of ours
        raise AssertionError(f"an interruption ended in a traceback:\n{said}")
    if output.exists() and output.suffix == ".h5":  # whole, then
        open_artefact(output, read_kind(output)).close()
    return alive


def pixels(path: Path) -> np.ndarray:
    """Of a picture; GeoTIFF by rasterio, since OpenImageIO may lack its compression."""
    if path.suffix != ".tif":
        return oiio.ImageBuf(str(path)).get_pixels()
    with rasterio.open(path) as file:
        return file.read()


def compare(name: str, first: Path, second: Path) -> None:
    if second.suffix == ".h5":
        assert_same(first, second)
    else:  # an EXR carries the time of its writing: what counts are the pixels
        for a in sorted(p for p in first.parent.glob(f"{first.stem}.*") if p.suffix != ".json"):
            x, y = (pixels(p) for p in (a, second.parent / a.name))
            if x.shape != y.shape or x.tobytes() != y.tobytes():
                raise AssertionError(f"{a.name} differs")


def endure(name: str, command: list[object], reference: Path, seconds: float, rng: random.Random, resume: bool) -> str:
    """One trial; what was done to it."""
    with tempfile.TemporaryDirectory() as folder:
        output = output_of(Path(folder), name)
        # without --resume, only --overwrite gives the state of an unfinished training up
        full = [
            *with_resume(name, command, resume),
            "-o",
            output,
            *([] if resume or name != "train" else ["--overwrite"]),
        ]
        blows = []
        for _ in range(rng.choice((1, 1, 2))):
            how = rng.choice((signal.SIGINT, signal.SIGKILL))
            after = rng.uniform(0.0, 1.05 * seconds)
            caught = interrupt(full, output, how, after)
            blows.append(f"{signal.Signals(how).name} at {after:.2f} s" + ("" if caught else " (too late)"))
        code, said = lunargr(*full, *(["--overwrite"] if output.exists() else []))
        if code != 0:
            raise AssertionError(f"after {', '.join(blows)} the rerun ended with {code}: {said}")
        compare(name, reference, output)
        left = {p.name for p in Path(folder).iterdir()} - {p.name for p in reference.parent.iterdir()}
        if left:
            raise AssertionError(f"after {', '.join(blows)} this was left: {', '.join(sorted(left))}")
        return ", ".join(blows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=20, help="interrupted runs per stage")
    parser.add_argument("--stages", help="comma-separated; all where left out")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        paths = write_inputs(Path(folder))
        paths["svbrdf"] = Path(folder) / "svbrdf.h5"
        code, said = lunargr(*stages(paths)["infer"], "-o", paths["svbrdf"])
        assert code == 0, said
        todo = commands(paths)
        for name in options.stages.split(",") if options.stages else todo:
            rng = random.Random(f"{options.seed} {name}")
            home = Path(folder) / name
            home.mkdir()
            reference = output_of(home, name)
            began = time.monotonic()
            code, said = lunargr(*todo[name], "-o", reference)
            assert code == 0, said
            seconds = time.monotonic() - began
            bad = 0
            for k in range(options.times):
                try:
                    done = endure(name, todo[name], reference, seconds, rng, resume=k % 4 != 3)
                    print(f"{name} {k + 1}/{options.times}: {done}: same", flush=True)
                except AssertionError as error:
                    bad += 1
                    print(f"{name} {k + 1}/{options.times}: {error}", flush=True)
            print(f"== {name}: {options.times - bad} of {options.times} ended with the same bytes", flush=True)
            failed += bad
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
