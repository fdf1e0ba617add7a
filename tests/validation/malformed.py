"""`make fuzz`: some hundreds of malformed inputs through the real commands; each must end in one line and leave nothing.

Refused means exit code 3 (2 for usage), one line on standard error that names what is wrong and what to do, no traceback,
no new or changed file, within LIMIT seconds. Cases with a ``warning`` are those where going on is right: exit code 0, and
that warning on standard error.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LIMIT = 60  # seconds a case may take; those that are refused take far less
HUGE = 1e30
_PROGRESS = re.compile(r"\d+% \d+:\d\d:\d\d\b")  # how far a command had come


@dataclass(frozen=True)
class Case:
    """``prepare`` makes the folder of good files bad; ``arguments`` is the command; ``names``: what its line must name."""

    name: str
    arguments: Sequence[str]
    names: str = ""
    prepare: Callable[[Path], None] = field(default=lambda folder: None)
    warning: str = ""


@dataclass(frozen=True)
class Outcome:
    """``fault`` is '' where the case ended as it must."""

    case: Case
    code: int
    error: str
    seconds: float
    fault: str


def all_cases() -> list[Case]:
    """Every malformed input, each with a name of its own."""
    from malformed_artefacts import artefact_cases
    from malformed_inputs import camera_cases, option_cases, raster_cases, recipe_cases, table_cases
    from malformed_views import view_cases

    cases = [*artefact_cases(), *table_cases(), *camera_cases(), *recipe_cases(), *raster_cases(), *option_cases()]
    cases += view_cases()
    twice = [name for name, count in Counter(c.name for c in cases).items() if count > 1]
    if twice:
        raise ValueError(f"cases of one name: {twice[:5]}")
    return cases


def good_files(folder: Path) -> Path:
    """What the cases make bad: a small scene's files and every artefact of it, in one folder."""
    from unittest.mock import patch

    import small_scene
    from malformed_inputs import write_camera
    from malformed_views import write_views

    from schemas import DIAGNOSIS, ArtefactWriter
    from stages import evaluate, infer, ingest, project, sample, train

    with patch.object(small_scene, "SIZE", 192):
        files = small_scene.write_scene(folder, images=2, nodata_hole=False)
    paths = {name: folder / f"{name}.h5" for name in ("scene", "crops", "pairs", "checkpoint", "svbrdf")}
    ingest.run(files.dem, files.images, paths["scene"], ingest.Config(gsd=20, crop=32))
    sample.run(paths["scene"], paths["crops"], sample.Config(count=24, tile_m=640, seed=3))
    project.run(paths["crops"], paths["pairs"], project.Config())
    options = {"epochs": 1, "batch": 8, "dropout": (0.0,) * 3, "device": "cpu", "precision": "fp32", "lr": 1e-2}
    train.run(paths["pairs"], paths["checkpoint"], train.Config(model="M2", widths=(4, 4, 8), **options))  # type: ignore[arg-type]
    infer.run(paths["scene"], paths["checkpoint"], paths["svbrdf"], infer.Config(device="cpu"))
    scoring = evaluate.Config(split="train", renderings=True, device="cpu", only=("learned", "global"))
    evaluate.run(paths["pairs"], paths["checkpoint"], folder / "evaluation.h5", scoring)
    extension = '[{"effect": "dark_bias", "values": {"iof": 0.001}, "survey": {}}]'
    sizes = {"frame": 1, "axis": 2, "mode": 6, "column": 4, "site": 1, "term": 1}
    attributes = {"report": "{}", "extension": extension}
    with ArtefactWriter(folder / "diagnosis.h5", DIAGNOSIS, sizes, attributes=attributes) as out:
        out.write("image_id", ["IMG0"])
    write_camera(folder / "camera.json")
    write_views(folder)
    return folder


class _TooLong(BaseException):
    pass


def _alarm(number: int, frame: Any) -> None:
    raise _TooLong


def run_here(arguments: Sequence[str], limit: int = LIMIT) -> tuple[int, str]:
    """(exit code, standard error) of a command in this process, as ``main`` ends it; 1 and the traceback's end for a bug."""
    from typer.testing import CliRunner

    from lunargr_cli.console import harmless
    from lunargr_cli.main import app
    from schemas.errors import EXIT_CODE, LunargrError

    before = signal.signal(signal.SIGALRM, _alarm)
    signal.alarm(limit)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            result = CliRunner().invoke(app, list(arguments))
    except _TooLong:
        return 124, f"still running after {limit} s"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    error = result.exception
    if isinstance(error, LunargrError):
        line = harmless(" ".join(str(error).split()))
        return EXIT_CODE, f"{result.stderr}lunargr: {line}\n"
    if error is not None and not isinstance(error, SystemExit):
        return 1, f"{result.stderr}Traceback: {type(error).__name__}: {error}\n"
    return result.exit_code, result.stderr


def run_command(arguments: Sequence[str], limit: int = 2 * LIMIT) -> tuple[int, str]:
    """The same as a shell starts it."""
    words = [sys.executable, "-m", "lunargr_cli.main", *arguments]
    try:
        done = subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=limit)
    except subprocess.TimeoutExpired:
        return 124, f"still running after {limit} s"
    return done.returncode, done.stderr


def run_case(case: Case, good: Path, run: Callable[[Sequence[str]], tuple[int, str]] = run_here) -> Outcome:
    """Make the bad input in a fresh copy of ``good``, run the command there and judge how it ended."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "work"
        shutil.copytree(good, folder)
        case.prepare(folder)
        with contextlib.chdir(folder):
            before = _listing(folder)
            began = time.monotonic()
            code, error = run(case.arguments)
            seconds = time.monotonic() - began
            fault = _judge(case, code, error, _listing(folder) != before)
    return Outcome(case, code, error, seconds, fault)


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    found = {str(p.relative_to(folder)): p.lstat() for p in folder.rglob("*")}
    return {name: (state.st_size, state.st_mtime_ns) for name, state in found.items()}


def _judge(case: Case, code: int, error: str, changed: bool) -> str:
    if case.warning:
        if code != 0:
            return f"refused ({code})"
        return "" if case.warning in error else "no warning"
    if code == 124:
        return "hangs"
    if code == 0:
        return "accepted"
    if code not in (2, 3):
        return "traceback"
    if changed:
        return "left something"
    lines = [line for line in error.splitlines() if line.strip() and not _PROGRESS.search(line)]
    if code == 2:
        return "" if lines and lines[0].startswith("Usage") else "usage error without usage"
    if len(lines) != 1:
        return f"{len(lines)} lines"
    if any(ord(c) < 32 for c in lines[0]):
        return "control characters"
    if case.names not in lines[0]:
        return f"does not name {case.names}"
    if lines[0].startswith("lunargr: --"):  # the option that it names is what to change
        return ""
    return "" if ";" in lines[0] or ". " in lines[0].rstrip(".") else "no remedy"


def controls() -> Iterator[Case]:
    """The commands of the cases on good files: where these fail, nothing that is refused means anything."""
    from malformed_artefacts import READERS
    from malformed_inputs import CONTROLS
    from malformed_views import CONVERT, MERGE, TRAJECTORY

    seen = set()
    for arguments in (
        *(words for readers in READERS.values() for words in readers),
        *CONTROLS,
        TRAJECTORY,
        MERGE,
        CONVERT,
    ):
        if tuple(arguments) not in seen and arguments[0] != "diagnose":  # takes minutes
            seen.add(tuple(arguments))
            yield Case("control: " + " ".join(arguments), arguments)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name matches this regular expression")
    parser.add_argument("--processes", type=int, default=25, help="every so manieth case also as a process of its own")
    arguments = parser.parse_args()
    faults: list[Outcome] = []
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        good = good_files(Path(name) / "good")
        for case in controls():
            if re.search(arguments.only, case.name):
                outcome = run_case(case, good)
                counts["controls"] += 1
                if outcome.code != 0:
                    faults.append(Outcome(case, outcome.code, outcome.error, outcome.seconds, "control fails"))
                    print(f"control fails  {case.name}: {outcome.error[-300:]}", flush=True)
        cases = [c for c in all_cases() if re.search(arguments.only, c.name)]
        for number, case in enumerate(cases):
            outcomes = [run_case(case, good)]
            if arguments.processes and number % arguments.processes == 0:
                outcomes.append(run_case(case, good, run_command))
                counts["processes"] += 1
            counts["cases"] += 1
            counts["warned" if case.warning else f"exit {outcomes[0].code}"] += 1
            for outcome in outcomes:
                if outcome.fault:
                    faults.append(outcome)
                    counts[outcome.fault] += 1
                    print(f"{outcome.fault:16s} {case.name}: {outcome.error.strip()[-240:]}", flush=True)
            if outcomes[0].seconds > 10:
                print(f"{outcomes[0].seconds:14.0f} s {case.name}", flush=True)
    print(", ".join(f"{what}: {count}" for what, count in sorted(counts.items())))
    print(f"{len(faults)} faults in {counts['cases']} malformed inputs")
    return 1 if faults else 0


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.path.append(str(Path(__file__).resolve().parents[1] / "support"))
    sys.modules["malformed"] = sys.modules["__main__"]  # the cases import from here
    sys.exit(main())
