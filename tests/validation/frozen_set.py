"""Compare two versions of `lunargr diagnose` on a frozen set of pairs files: make the set, answer it, compare the answers.

    python tests/validation/frozen_set.py make --folder FOLDER --jobs 2
    python tests/validation/frozen_set.py run --folder FOLDER --answers after.json --jobs 2
    python tests/validation/frozen_set.py compare tests/validation/frozen_answers.json after.json

All seeds are fixed. `run` diagnoses with the code of the working directory. Sources are interleaved, so that every part of the set
(--every, --offset) is a fair sample. An interrupted `make` or `run` goes on where it was. frozen_answers.json holds answers of the
version before the one judge, commit f1353f5.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import campaign
import planted
from hidden.scene import SHARED

SEED = 670
CASES = 48  # of each laboratory
WORLDS = ("usual", "photograph", "usual", "four_images")  # one for each own scene
RESAMPLES = 3  # of each stack of photographs
PHOTOGRAPHS = SHARED / "data" / "apollo15"
STACKS = ("raw", "registered")


@dataclass(frozen=True)
class File:
    """A file of the set; make : writes it to a path and returns its truth."""

    source: str
    name: str
    make: Callable[[Path], dict]


def in_laboratory(laboratory: str, number: int, dealt: object, path: Path) -> dict:
    """A laboratory's case."""
    truth = importlib.import_module(f"{laboratory}.cases").make_case(number, dealt, SEED, path)
    return truth | {"given_law": dealt.given_law, "fault": next(iter(truth.get("fault", {})), None)}


def in_own_scene(layout: campaign.Layout, cache: Path, seed: int, job: dict, kind: str, path: Path) -> dict:
    """A case of an own scene, with the size that its random draws came to."""
    scene, law = campaign.scene_of(layout, cache), campaign.draw_law(seed, [x for x in campaign.LAWS if x != "linear"])
    truth = campaign.make(scene, campaign.aimed(job, scene), seed, path, law, kind)
    effect = next(iter(truth["planted"]), None)
    if effect in campaign.UNKNOWN:
        return truth | {"planted": {}, "fault": effect}
    if effect in truth["drawn"]:
        values = truth["planted"][effect]
        truth["planted"] = {effect: values | {next(iter(values)): truth["drawn"][effect]}}
    return truth


def in_photographs(stack: Path, plant: str | None, seed: int | None, path: Path) -> dict:
    """A stack of photographs with a plant, with places drawn again, or as it is (`beside`: its names do not count as false)."""
    truth = {"planted": {}, "beside": _whole(stack)}
    if plant is not None:
        parts = planted.PLANTS[plant]
        planted.plant(stack, path, plant)
        return truth | {"planted": {parts["effect"]: dict([parts["is"]] if "is" in parts else [])}}
    if seed is not None:
        planted.resample(stack, path, seed)
    else:
        shutil.copyfile(stack, path)
    return truth


def _whole(stack: Path) -> str:
    return f"photographs_{stack.stem}_whole"


def _own_files(cache: Path) -> Iterator[File]:
    rng = np.random.default_rng(SEED)
    for k, kind in enumerate(WORLDS):
        only = list(campaign.PLANTS)[k :: len(WORLDS)]
        options = Namespace(
            sites=5, images=12, size=128, nulls=2, plants=1, strengths=[1.0], only=only, draw=0, unknown=2
        )
        layout = campaign.draw_layout(rng, options, kind)
        for seed, job in campaign.draw_jobs(rng, layout, options):
            yield File("own", f"own_{k}_{seed}", partial(in_own_scene, layout, cache, seed, job, kind))


def _photographs(folder: Path) -> Iterator[File]:
    for kind in STACKS:
        stack = folder / f"{kind}.h5"
        yield File("photographs", _whole(stack), partial(in_photographs, stack, None, None))
        for k, plant in enumerate(planted.PLANTS):
            yield File("photographs", f"photographs_{kind}_plant_{k:02d}", partial(in_photographs, stack, plant, None))
        for seed in range(SEED, SEED + RESAMPLES):
            yield File("photographs", f"photographs_{kind}_again_{seed}", partial(in_photographs, stack, None, seed))


def every_file(folder: Path) -> list[File]:
    """The set, its sources interleaved; stacks of photographs as they are come first."""
    sources: list[list[File]] = []
    for name in ("laboratory", "second_laboratory"):
        hands = importlib.import_module(f"{name}.cases").deal(SEED, CASES)
        dealt = [replace(hand, given_law=k % 2 == 1) for k, hand in enumerate(hands)]
        sources.append([File(name, f"{name}_{k:03d}", partial(in_laboratory, name, k, d)) for k, d in enumerate(dealt)])
    sources.append(list(_own_files(folder / "scenes")))
    sources.append(list(_photographs(folder / "stacks")) if PHOTOGRAPHS.exists() else [])
    rng, placed = np.random.default_rng(SEED), []
    for files in sources:
        whole = [file for file in files if file.name.endswith("_whole")]
        others = [file for file in files if file not in whole]
        placed += [(-1.0, file) for file in whole]
        placed += [((k + 0.5) / len(others), others[i]) for k, i in enumerate(rng.permutation(len(others)))]
    return [file for _, file in sorted(placed, key=lambda x: x[0])]


def prepare_stacks(folder: Path) -> None:
    """Pairs of the photographs, as `make results/apollo15/diagnosis.h5` makes them, and registered ones."""
    folder.mkdir(parents=True, exist_ok=True)
    scene, crops = folder / "scene.h5", folder / "crops.h5"
    dem, table = PHOTOGRAPHS / "gld100_64ppd.tif", PHOTOGRAPHS / "images.csv"
    steps = {
        scene: f"ingest {dem} --images {table} --gsd 474 --crop 48",
        crops: f"sample {scene} --stack --count 24 --tile-m 32000 --split 70/10/20",
        folder / "raw.h5": f"project {crops} --exact",
        folder / "registered.h5": f"project {crops} --exact --register field",
    }
    for made, step in steps.items():
        if not made.exists():
            command = [sys.executable, "-m", "lunargr_cli.main", *step.split(), "-o", str(made), "--quiet"]
            subprocess.run(command, check=True)


def make(file: File, folder: Path) -> None:
    """Write the file, and what is true of it beside it, before."""
    path, part = folder / f"{file.name}.h5", folder / f"{file.name}.part.h5"
    truth = file.make(part)
    short = {"source": file.source, "planted": truth["planted"], "fault": truth.get("fault"), "fid": truth.get("fid")}
    short |= {"beside": truth.get("beside"), "maker": truth}
    _write(path.with_suffix(".json"), json.dumps(short, indent=1))
    part.replace(path)


def answer(pairs: Path) -> dict:
    """What the command line of the working directory answers, short, with its processor time and the file's truth."""
    with tempfile.TemporaryDirectory() as scratch:
        said, log = Path(scratch) / "answer.json", Path(scratch) / "log"
        command = [sys.executable, "-m", "lunargr_cli.main", "diagnose", str(pairs), "--json", str(said), "--quiet"]
        with log.open("w") as to:
            job = subprocess.Popen(command, stdout=to, stderr=to)
            _, job.returncode, used = os.wait4(job.pid, 0)
        if job.returncode:
            raise RuntimeError(f"diagnose {pairs.name}: {log.read_text().strip()[-1000:]}")
        full = json.loads(said.read_text())
    truth = json.loads(pairs.with_suffix(".json").read_text())
    return {
        "source": truth["source"],
        "planted": _short(truth["planted"]),
        "fault": truth["fault"],
        "fid": _short(truth["fid"]),
        "beside": truth["beside"],
        "verdict": full["verdict"],
        "causes": [_named(cause) for cause in full["causes"]],
        "refused": {x["effect"]: _reason(x, truth["planted"]) for x in full["rejected"]},
        "blind": full["blind"],
        "structure": _short({x["what"]: x["share"] for x in full["structure"]}),
        "gain": _short([full["held_out"][key] for key in ("gain_percent", "gain_percent_low", "gain_percent_high")]),
        "seconds": round(used.ru_utime + used.ru_stime, 1),
    }


def _reason(refused: dict, planted: dict) -> str:
    """With its numbers where the effect is planted, else the first words."""
    return refused["why"] if refused["effect"] in planted else refused["why"].split(" (")[0][:60]


def _named(cause: dict) -> dict:
    values = {name: [found["value"], found["error"]] for name, found in cause["parameters"].items()}
    gain = [cause[key] for key in ("held_out_gain_percent", "held_out_low", "held_out_high")]
    return _short({"effect": cause["effect"], "values": values, "gain": gain})


def _short(x: object) -> object:
    """The same with numbers of four digits."""
    if isinstance(x, dict):
        return {key: _short(value) for key, value in x.items()}
    if isinstance(x, list):
        return [_short(value) for value in x]
    return float(f"{x:.4g}") if isinstance(x, float) else x


def judge(name: str, cases: dict[str, dict]) -> dict[str, float]:
    """What is counted of a case, 0 or 1 each, and its seconds; a name that the whole stack of photographs has too is none."""
    case = cases[name]
    effect = next(iter(case["planted"]), None)
    usual = {c["effect"] for c in cases.get(case["beside"], case)["causes"]} if case["beside"] != name else set()
    causes = [c for c in case["causes"] if not case["beside"] or c["effect"] == effect or c["effect"] not in usual]
    first = causes[0]["effect"] if causes else None
    off = _errors_off(case["planted"][effect], causes[0]["values"]) if effect and first == effect else None
    silence = "refused" if effect in case["refused"] else "blind" if effect in case["blind"] else "nothing"
    how = "first" if first == effect else "another" if first else silence
    null, words = not effect and not case["fault"] and case["beside"] != name, bool(case["structure"])
    return {
        "planted": bool(effect),
        **{kind: bool(effect) and how == kind for kind in ("first", "another", "refused", "blind", "nothing")},
        "values": off is not None,
        "in 3 errors": off is not None and off <= 3,
        "null": null,
        "null: named": null and bool(causes),
        "null: words": null and words,
        "fault": bool(case["fault"]),
        "fault: named": bool(case["fault"] and causes),
        "fault: words": bool(case["fault"]) and words,
        "seconds": case["seconds"],
    }


def _errors_off(planted: dict, found: dict) -> float | None:
    """By how many errors the first parameter that both have is off; None where there is none."""
    for name, (value, error) in found.items():
        if error and isinstance(planted.get(name), int | float):
            return abs(value - planted[name]) / error
    return None


def table(versions: dict[str, dict[str, dict]]) -> Iterator[str]:
    """Counts of each source and version, in Markdown; every version has the same files."""
    cases = next(iter(versions.values()))
    columns = list(judge(next(iter(cases)), cases))
    yield "| source | version | files | " + " | ".join(columns) + " |"
    yield "|---" * (3 + len(columns)) + "|"
    for source in [*sorted({case["source"] for case in cases.values()}), "all"]:
        names = [name for name, case in cases.items() if source in (case["source"], "all")]
        for version, answers in versions.items():
            rows = [judge(name, answers) for name in names]
            counts = " | ".join(f"{sum(row[column] for row in rows):.0f}" for column in columns)
            yield f"| {source} | {version} | {len(rows)} | {counts} |"


def told(case: dict) -> str:
    """A case's answer in a line: verdict, names with first values, words, and what became of the planted effect."""
    effect = next(iter(case["planted"]), None)
    values = [(c["effect"], *next(iter(c["values"].values()), ("-", "-"))) for c in case["causes"]]
    parts = [case["verdict"], *(f"{name} {value} +- {error}" for name, value, error in values), *case["structure"]]
    parts += [f"refused: {case['refused'][effect]}"] if effect in case["refused"] else []
    return "; ".join(parts + (["blind"] if effect in case["blind"] else []))


def changed(old: dict, new: dict) -> bool:
    """Another verdict, other names or words, or a first value that moved by over an error."""
    keys = [(x["verdict"], [c["effect"] for c in x["causes"]], list(x["structure"])) for x in (old, new)]
    if keys[0] != keys[1] or not old["causes"]:
        return keys[0] != keys[1]
    values = {name: value for name, (value, _) in new["causes"][0]["values"].items()}
    return (_errors_off(values, old["causes"][0]["values"]) or 0) > 1


def compare(before: dict[str, dict], after: dict[str, dict]) -> None:
    """Print what changed, file by file, and the counts."""
    both = [name for name in before if name in after]
    if not both:
        sys.exit("no file is answered in both")
    for name in both:
        old, new = before[name], after[name]
        if changed(old, new):
            hidden = old["planted"] or old["fault"] or "nothing"
            print(f"{name}: {hidden}, fid {old['fid']}\n  before: {told(old)}\n  after:  {told(new)}")
    print("\n".join(table({"before": {n: before[n] for n in both}, "after": {n: after[n] for n in both}})))


def _write(path: Path, text: str) -> None:
    part = path.with_name(path.name + ".part")
    part.write_text(text)
    part.replace(path)


def _ended(pool: Executor, jobs: dict[str, Callable]) -> Iterator[tuple[str, Future]]:
    """Names and jobs as they end, each told; those that failed end the program at the end."""
    futures, failed = {pool.submit(job): name for name, job in jobs.items()}, []
    for count, future in enumerate(as_completed(futures), 1):
        name, error = futures[future], future.exception()
        print(f"{count}/{len(jobs)} {name}{f' failed: {error}' if error else ''}", flush=True)
        if error:
            failed.append(name)
        else:
            yield name, future
    if failed:
        sys.exit(f"{len(failed)} of {len(jobs)} failed: {', '.join(failed)}")


def make_all(files: list[File], folder: Path, processes: int) -> None:
    """Make the files that are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    if PHOTOGRAPHS.exists():
        prepare_stacks(folder / "stacks")
    else:
        print(f"no photographs: {PHOTOGRAPHS} is not there (set LUNARGR_SHARED)")
    jobs = {file.name: partial(make, file, folder) for file in files if not (folder / f"{file.name}.h5").exists()}
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        for _ in _ended(pool, jobs):
            pass


def run_all(files: list[File], folder: Path, record: Path, processes: int) -> None:
    """Answer the files that are there and not yet in the record."""
    answers = json.loads(record.read_text()) if record.exists() else {}
    todo = {file.name: folder / f"{file.name}.h5" for file in files if file.name not in answers}
    jobs = {name: partial(answer, path) for name, path in todo.items() if path.exists()}
    print(f"{len(files) - len(todo)} are answered already, {len(todo) - len(jobs)} are not made yet")
    with ThreadPoolExecutor(processes) as pool:
        for name, future in _ended(pool, jobs):
            answers[name] = future.result()
            lines = ",\n".join(f"{json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in answers.items())
            _write(record, f"{{\n{lines}\n}}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in ("make", "run"):
        sub = verbs.add_parser(verb)
        sub.add_argument("--folder", type=Path, required=True)
        sub.add_argument("--jobs", type=int, default=1, help="processes")
        sub.add_argument("--every", type=int, default=1, help="only one file in so many")
        sub.add_argument("--offset", type=int, default=0)
    verbs.choices["run"].add_argument("--answers", type=Path, required=True)
    sub = verbs.add_parser("compare")
    sub.add_argument("answers", type=Path, nargs=2, help="before, after")
    a = parser.parse_args()
    if a.verb == "compare":
        compare(*(json.loads(path.read_text()) for path in a.answers))
        return
    os.environ["OMP_NUM_THREADS"] = "1"
    folder = a.folder.resolve()
    files = every_file(folder)
    files = [file for k, file in enumerate(files) if k % a.every == a.offset or file.name.endswith("_whole")]
    if a.verb == "make":
        make_all(files, folder, a.jobs)
    else:
        run_all(files, folder, a.answers, a.jobs)


if __name__ == "__main__":
    main()
