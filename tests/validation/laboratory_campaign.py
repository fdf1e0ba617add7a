"""Judge `lunargr diagnose` by another laboratory's simulator: files of which it knows nothing, against what was hidden in them.

    python tests/validation/laboratory_campaign.py --seed N --cases 44 --jobs 2 --output results/laboratory [--laboratory second_laboratory]

Makes each case in OUTPUT/ (see tests/validation/laboratory and tests/validation/second_laboratory: two authors, nothing in common), runs the command line on it, and writes OUTPUT.json (every case, as it comes)
and OUTPUT.md (tables); cases that OUTPUT.json holds already are not done again. A seed is drawn once, after the code is frozen.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from sure_names import doubtful

LABORATORIES = ("laboratory", "second_laboratory")
ROOT = Path(__file__).parents[2]
BINS = ((0.0, 0.08), (0.08, 0.15), (0.15, 0.4), (0.4, math.inf))  # of fid
RIGHT, ANOTHER, BLIND, DENIED = "right", "another first", "no name, in `blind`", "no name, not in `blind`"
HONEST, BARE, NOTHING = "unexplained, or named with structure left", "named without structure", "nothing said"


def diagnose(pairs: Path, answer: Path) -> dict:
    """The JSON that a user gets from the command line."""
    command = [sys.executable, "-m", "lunargr_cli.main", "diagnose", str(pairs), "--json", str(answer)]
    done = subprocess.run([*command, "--overwrite", "--quiet"], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"diagnose {pairs.name} ended with {done.returncode}: {done.stderr.strip()[-2000:]}")
    return json.loads(answer.read_text())


def work(laboratory: str, number: int, dealt: object, seed: int, folder: Path, keep: bool) -> dict:
    """One case from making its file to the answer, in a process of its own."""
    pairs, answer = folder / f"case_{number:03d}.h5", folder / f"case_{number:03d}.answer.json"
    try:
        truth = importlib.import_module(f"{laboratory}.cases").make_case(number, dealt, seed, pairs)
        started = time.perf_counter()
        found = diagnose(pairs, answer)
        return truth | {"seconds": time.perf_counter() - started, "answer": found}
    finally:
        if not keep:
            pairs.unlink(missing_ok=True)
            answer.unlink(missing_ok=True)


def judged(case: dict) -> str:
    """How a single plant was answered."""
    planted, answer = next(iter(case["planted"])), case["answer"]
    if answer["causes"]:
        return RIGHT if answer["causes"][0]["effect"] == planted else ANOTHER
    return BLIND if planted in answer["blind"] else DENIED


def judged_fault(case: dict) -> str:
    """How a fault of no catalogue was answered."""
    answer = case["answer"]
    if answer["verdict"] == "unexplained" or (answer["causes"] and answer["structure"]):
        return HONEST
    return BARE if answer["causes"] else NOTHING


def summarise(cases: list[dict]) -> str:
    """Markdown tables, every share with its counts."""
    cases = sorted(cases, key=lambda case: case["case"])
    nulls = [case for case in cases if not case["planted"] and not case["unknown"]]
    single = [case for case in cases if case["planted"]]
    faults = [case for case in cases if case["unknown"]]
    seeds = ", ".join(sorted({str(case["seed"]) for case in cases}))
    lines = ["# `lunargr diagnose` judged by another laboratory's simulator", ""]
    lines += [
        f"Written by `tests/validation/laboratory_campaign.py`, seed {seeds}; every share is a count.",
        "",
        "| | |",
        "|---|---|",
    ]
    named = sum(bool(case["answer"]["causes"]) for case in nulls)
    unexplained = sum(case["answer"]["verdict"] == "unexplained" for case in nulls)
    lines.append(f"| nothing hidden: a cause named | {_share(named, len(nulls))} |")
    lines.append(f"| nothing hidden: `unexplained` | {_share(unexplained, len(nulls))} |")
    verdicts = Counter(case["answer"]["verdict"] for case in nulls)
    lines.append(f"| nothing hidden: verdicts | {_counts(verdicts)} |")
    kinds = Counter(judged(case) for case in single)
    lines += [
        f"| one effect: {kind} | {_share(kinds[kind], len(single))} |" for kind in (RIGHT, ANOTHER, BLIND, DENIED)
    ]
    kinds = Counter(judged_fault(case) for case in faults)
    lines += [
        f"| outside the catalogue: {kind} | {_share(kinds[kind], len(faults))} |" for kind in (HONEST, BARE, NOTHING)
    ]
    lines += doubtful([case["answer"] for case in cases])
    return "\n".join([*lines, *_by_strength(single), *_single(single), *_faults(faults), *_nulls(nulls)]) + "\n"


def _by_strength(single: list[dict]) -> list[str]:
    lines = ["", "## One effect, by its strength over the noise (fid)", ""]
    lines += [f"| fid | cases | {RIGHT} | {ANOTHER} | {BLIND} | {DENIED} |", "|---|---|---|---|---|---|"]
    for low, high in BINS:
        mine = [case for case in single if low <= case["fid"] < high]
        kinds = Counter(judged(case) for case in mine)
        title = f"> {low}" if high == math.inf else f"< {high}" if low == 0 else f"{low} to {high}"
        counts = " | ".join(str(kinds[kind]) for kind in (RIGHT, ANOTHER, BLIND, DENIED))
        lines.append(f"| {title} | {len(mine)} | {counts} |")
    return [
        *lines,
        "",
        "fid: rms over lit pixels of what the effect changes, over that of the noise, once a plane per image and the mean of each "
        "ground pixel are taken away. Effects that act as gains of whole images have none left; their gains are given instead. "
        "fid of effects that show in shadows is small too: beside it stands the ratio over all pixels.",
    ]


def _single(single: list[dict]) -> list[str]:
    lines = ["", "## One effect, case by case", ""]
    lines += ["| case | planted | fid | | verdict | named | structure |", "|---|---|---|---|---|---|---|"]
    for case in single:
        planted = "; ".join(f"`{effect}` {_values(values)}" for effect, values in case["planted"].items())
        lines.append(
            f"| {case['case']} ({case['layout']}) | {planted} | {_size(case)} | {judged(case)} | {_answer(case['answer'])} |"
        )
    return lines


def _faults(faults: list[dict]) -> list[str]:
    lines = ["", "## Faults of no catalogue", ""]
    lines += ["| case | fault | fid | | verdict | named | structure |", "|---|---|---|---|---|---|---|"]
    for case in faults:
        fault = next(iter(case["fault"]))
        lines.append(
            f"| {case['case']} ({case['layout']}) | {fault} | {_size(case)} | {judged_fault(case)} | {_answer(case['answer'])} |"
        )
    return lines


def _nulls(nulls: list[dict]) -> list[str]:
    lines = ["", "## Nothing hidden", "", "| case | law | verdict | named | structure |", "|---|---|---|---|---|"]
    return lines + [
        f"| {case['case']} ({case['layout']}) | {case['law'].split(',')[0]} | {_answer(case['answer'])} |"
        for case in nulls
    ]


def _answer(answer: dict) -> str:
    """Three cells: verdict, names with values and errors, structure."""
    named = "; ".join(f"`{cause['effect']}` {_found(cause['parameters'])}" for cause in answer["causes"])
    structure = "; ".join(f"{left['what']} {_number(left['share'])}" for left in answer["structure"])
    return f"{answer['verdict']} | {named or '-'} | {structure or '-'}"


def _found(parameters: dict) -> str:
    parts = []
    for name, found in parameters.items():
        error = "" if found["error"] is None else f" ± {_number(found['error'])}"
        parts.append(f"{name} = {_number(found['value'])}{error}")
    return ", ".join(parts)


def _values(values: dict) -> str:
    return ", ".join(f"{name} = {_number(value)}" for name, value in values.items())


def _number(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _size(case: dict) -> str:
    """fid, and what the case was calibrated on where that is something else."""
    size = f"{case['fid']:.3f}"
    if case["calibrated_on"] == "rms_of_pair_gains":
        size += f" (gains {100 * case['rms_of_pair_gains']:.1f} %)"
    elif case["calibrated_on"] == "fid_abs_all_pixels":
        size += f" (all pixels {case['fid_abs_all_pixels']:.2f})"
    return size


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else "not run"


def _counts(counter: Counter) -> str:
    return ", ".join(f"{name} {count}" for name, count in counter.most_common()) or "-"


def _line(done: dict) -> str:
    answer = done["answer"]
    hidden = ",".join(done["planted"] or done.get("fault", {})) or "nothing"
    named = ",".join(cause["effect"] for cause in answer["causes"]) or "-"
    return (
        f"{done['case']:03d} {done['layout']} {hidden:24s} fid {done['fid']:.3f} -> {answer['verdict']} {named} "
        f"blind {answer['blind']} {done['seconds']:.0f} s"
    )


def _write(path: Path, text: str) -> None:
    """Whole or not at all, so that an interrupted campaign can go on."""
    part = path.with_name(path.name + ".part")
    part.write_text(text)
    part.replace(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--cases", type=int, default=44)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--laboratory", choices=LABORATORIES, default=LABORATORIES[0])
    parser.add_argument("--given-law", action="store_true", help="the ground follows M2, which diagnose is given")
    parser.add_argument("--keep", action="store_true", help="keep every case's file and answer in OUTPUT/")
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    folder: Path = options.output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    record, report = folder.with_name(folder.name + ".json"), folder.with_name(folder.name + ".md")
    cases: list[dict] = json.loads(record.read_text()) if record.exists() else []
    if any(case["seed"] != options.seed for case in cases):
        parser.error(f"{record} holds cases of another seed")
    known = {case["case"] for case in cases}
    hands = importlib.import_module(f"{options.laboratory}.cases").deal(options.seed, options.cases)
    hands = [replace(dealt, given_law=options.given_law) for dealt in hands]
    todo = [(number, dealt) for number, dealt in enumerate(hands) if number not in known]
    os.environ["OMP_NUM_THREADS"] = "1"  # of the workers and of the commands they run
    failed = []
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        jobs = {
            pool.submit(work, options.laboratory, number, dealt, options.seed, folder, options.keep): number
            for number, dealt in todo
        }
        for job in as_completed(jobs):
            try:
                done = job.result()
            except Exception as error:
                failed.append(jobs[job])
                print(f"{jobs[job]:03d} failed: {error}", file=sys.stderr, flush=True)
                continue
            cases.append(done)
            print(_line(done), flush=True)
            _write(record, json.dumps(cases, indent=1))
    if not any(folder.iterdir()):
        folder.rmdir()
    if cases:
        _write(report, summarise(cases))
        print(summarise(cases))
    if failed:
        sys.exit(f"no answer on cases {sorted(failed)}: see above")


if __name__ == "__main__":
    main()
