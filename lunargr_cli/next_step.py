"""What usually follows a command: its last line."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

Options = Mapping[str, Any]
# They only list something, or plan.
LISTS = ("list_effects", "list_matchers", "print_recipe")


def next_step(command: str, options: Options) -> str | None:
    """'lunargr project crops.h5 -o pairs.h5' after sample; None after what has nothing to go on with.

    options : the command's parameters by name
    """
    if command not in STEPS or any(options.get(name) for name in LISTS):
        return None
    if options.get("shard") and options["output"].suffix:
        return f"lunargr merge PART... -o FILE, of {options['output'].name} and the other parts"
    return STEPS[command](options)


def _run(*words: object, to: str = "", beside: Path | None = None) -> str:
    """A command line; its output gets the name ``to`` in the folder of ``beside``."""
    target = ["-o", beside.with_name(to)] if beside is not None else []
    return shlex.join(["lunargr", *map(_word, (*words, *target))])


def _word(word: object) -> str:
    """One word of a command line; a file whose name begins with a dash must not be read as an option."""
    return f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word)


def _open(path: Path) -> str:
    return f"open {shlex.quote(_word(path))}"


def _after(command: str, to: str) -> Callable[[Options], str]:
    """A command that reads the output alone."""
    return lambda o: _run(command, o["output"], to=to, beside=o["output"])


def _ingest(o: Options) -> str:
    if o["images"] is None:
        return _run("infer", o["output"], "checkpoint.h5", to="svbrdf.h5", beside=o["output"])
    return _run("sample", o["output"], to="crops.h5", beside=o["output"])


def _sample(o: Options) -> str:
    return _run("project", o["output"], to="stack.h5" if o["stack"] else "pairs.h5", beside=o["output"])


def _project(o: Options) -> str:
    train = _run("train", o["output"], to="checkpoint.h5", beside=o["output"])
    return f"{train}; or, of places that several images show, {_run('diagnose', o['output'])}"


def _train(o: Options) -> str:
    return _run("evaluate", o["pairs"], o["output"], to="evaluation.h5", beside=o["output"])


def _albedo(o: Options) -> str:
    if o["fold"] is None:
        return _run("view", o["output"], to="view.html", beside=o["output"])
    scored = _run("held-out", "pairs.h5", o["output"], to="held_out.h5", beside=o["output"])
    return f"{scored}, with the pairs of the same scene"


def _render(o: Options) -> str:
    output = o["output"]
    return _open(output if o["trajectory"] or o["stereo"] else output.with_suffix(".png"))


def _evaluate(o: Options) -> str:
    return _run("report", o["pairs"], *o["checkpoints"], o["output"], to="report.html", beside=o["output"])


def _match(o: Options) -> str:
    if o["json_file"] is None:
        return "the same with --json match.json, which lunargr report shows"
    return _run("report", o["json_file"], to="report.html", beside=o["json_file"])


def _diagnose(o: Options) -> str:
    if o["report"] is not None:
        return _open(o["report"])
    if o["output"] is not None:
        return _run("train", o["pairs"], "--extend", o["output"], to="checkpoint.h5", beside=o["output"])
    return "the same with --report diagnosis.html for pictures, with -o diagnosis.h5 for train, render and evaluate --extend"


def _compare(o: Options) -> str:
    table = o["output"] / "comparison.json"
    return _run("report", table, to="report.html", beside=table)


STEPS: dict[str, Callable[[Options], str]] = {
    "ingest": _ingest,
    "sample": _sample,
    "project": _project,
    "train": _train,
    "infer": _after("view", "view.html"),
    "albedo": _albedo,
    "refine": _after("view", "view.html"),
    "normalize": lambda o: _run("inspect", o["output"]),
    "render": _render,
    "view": lambda o: _open(o["output"]),
    "evaluate": _evaluate,
    "held-out": lambda o: _run("report", o["pairs"], o["output"], to="report.html", beside=o["output"]),
    "match": _match,
    "compare": _compare,
    "diagnose": _diagnose,
    "export": lambda o: _open(o["output"].with_suffix(".md")),
    "report": lambda o: _open(o["output"]),
    "merge": lambda o: _run("inspect", o["output"]),
    "convert": lambda o: _run("inspect", o["output"]),
}
