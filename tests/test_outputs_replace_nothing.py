"""No output of any command takes the place of an input: named or listed in a table, by path, link or hard link."""

from __future__ import annotations

import gc
import hashlib
import importlib
import os
import pkgutil
import shutil
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from lunargr_cli import commands
from lunargr_cli import main as cli
from lunargr_cli.spelling import option_of
from schemas import ConfigError, write_json
from schemas.files.outputs import Output
from stages.common import runner

SUN = ["--sun-azimuth", "100", "--sun-elevation", "35"]
# What each command reads, and the words that have it read that. Every command that writes must be here.
READS = {
    "simulate": (["recipe.json"], ["--recipe", "recipe.json"]),
    "ingest": (["dem.tif", "images.csv", "image1.tif"], ["dem.tif", "--images", "images.csv"]),
    "sample": (["scene.h5", "image1.tif", "dem.tif"], ["scene.h5"]),
    "project": (["crops.h5", "scene.h5", "image1.tif", "dem.tif"], ["crops.h5", "--register"]),
    "train": (["pairs.h5", "diagnosis.h5"], ["pairs.h5", "--extend", "diagnosis.h5"]),
    "infer": (["dem.tif", "checkpoint.h5"], ["dem.tif", "checkpoint.h5"]),
    "render": (["svbrdf.h5", "camera.json"], ["svbrdf.h5", "--camera", "camera.json", *SUN]),
    "evaluate": (["pairs.h5", "checkpoint.h5"], ["pairs.h5", "checkpoint.h5"]),
    "held-out": (["pairs.h5", "svbrdf.h5"], ["pairs.h5", "svbrdf.h5"]),
    "match": (["measured.png", "rendered.png"], ["measured.png", "rendered.png"]),
    "diagnose": (["pairs.h5", "checkpoint.h5"], ["pairs.h5", "checkpoint.h5"]),
    "compare": (["pairs.h5"], ["pairs.h5", "--models", "M1,M2"]),
    "report": (["scene.h5", "measured.png"], ["scene.h5", "measured.png"]),
    "convert": (["maps.tif"], ["maps.tif", "--from", "lunargr:hapke", "--to", "sato:Hapke"]),
    "merge": (["pairs.h5", "more.h5"], ["pairs.h5", "more.h5"]),
    "inspect": (["scene.h5", "image1.tif"], ["scene.h5"]),
    "models": ([], []),
    "albedo": (["svbrdf.h5", "scene.h5", "image1.tif", "dem.tif"], ["svbrdf.h5", "scene.h5"]),
    "refine": (["svbrdf.h5", "scene.h5", "image1.tif", "dem.tif"], ["svbrdf.h5", "scene.h5"]),
    "normalize": (["scene.h5", "svbrdf.h5", "image1.tif", "dem.tif"], ["scene.h5", "svbrdf.h5"]),
    "view": (["svbrdf.h5", "pairs.h5"], ["svbrdf.h5", "--pairs", "pairs.h5"]),
    "export": (["checkpoint.h5"], ["checkpoint.h5"]),
}
HOW = ("itself", "link", "hard link", "without --overwrite")
MODULES = [importlib.import_module(f"lunargr_cli.commands.{m.name}") for m in pkgutil.iter_modules(commands.__path__)]


# Parameters of commands that name what is written; of these outputs are folders.
WRITTEN = ("output", "json_file", "geotiff", "report", "shifts", "figures")
FOLDERS = {("simulate", "output"), ("compare", "output"), ("match", "figures"), ("evaluate", "figures")}


def written_options(module) -> list[tuple[str, bool]]:
    """The options of a command that name what it writes, and whether that is a folder."""
    command = get_command(cli.app).commands[module.NAME]
    names = [p.name for p in command.params if p.name in WRITTEN]
    return [(option_of(module.command, name), (module.NAME, name) in FOLDERS) for name in names]


@pytest.fixture(scope="session")
def inputs(small_files, small_artefacts, tmp_path_factory) -> Path:
    """A folder with what commands read. What is refused is never opened: only what names other files must be real."""
    folder = tmp_path_factory.mktemp("inputs")
    for path in small_files.folder.iterdir():
        shutil.copy(path, folder)
    from stages import ingest, sample

    ingest.run(folder / "dem.tif", folder / "images.csv", folder / "scene.h5", ingest.Config(gsd=40, crop=16))
    sample.run(folder / "scene.h5", folder / "crops.h5", sample.Config(count=20, tile_m=1280, seed=3))
    shutil.copy(small_artefacts["pairs"], folder / "pairs.h5")
    for name in ["recipe.json", "camera.json"]:
        (folder / name).write_text("{}")
    for name in ["more.h5", "checkpoint.h5", "diagnosis.h5", "svbrdf.h5", "maps.tif", "measured.png", "rendered.png"]:
        (folder / name).write_bytes(name.encode())
    return folder


def run(monkeypatch, capsys, *arguments) -> tuple[int, list[str]]:
    """Exit code and lines of standard error of `lunargr`."""
    monkeypatch.setattr(os, "_exit", sys.exit)
    monkeypatch.setattr(gc, "freeze", lambda: None)
    monkeypatch.setattr(sys, "argv", ["lunargr", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0), capsys.readouterr().err.splitlines()


def contents(folder: Path) -> dict[str, str]:
    """Every file, what it is and what is in it."""
    return {
        str(p.relative_to(folder)): f"{p.is_symlink()} {hashlib.sha256(p.read_bytes()).hexdigest()}"
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def refused(monkeypatch, capsys, folder: Path, arguments, victim: str) -> str:
    """Refused in one line that names no --overwrite, with every file as it was."""
    monkeypatch.chdir(folder)
    before = contents(folder)
    code, lines = run(monkeypatch, capsys, *arguments)
    assert code == 3 and len(lines) == 1, lines
    assert "would replace" in lines[0] and victim in lines[0] and "--overwrite" not in lines[0], lines
    assert contents(folder) == before
    return lines[0]


def cases():
    """Every command, option and input once; for one command in all disguises, which one mechanism sees through."""
    for module in MODULES:
        for option, is_folder in written_options(module):
            if not is_folder:
                for name in READS[module.NAME][0]:
                    for how in HOW if module.NAME == "infer" else HOW[:1]:
                        yield pytest.param(module.NAME, option, name, how, id=f"{module.NAME} {option} {name} {how}")


def test_every_command_that_writes_is_tried():
    writing = {module.NAME for module in MODULES if written_options(module)}
    assert writing == set(READS)


@pytest.mark.parametrize(("name", "option", "victim", "how"), list(cases()))
def test_an_output_never_replaces_an_input(monkeypatch, capsys, inputs, tmp_path, name, option, victim, how):
    _, words = READS[name]
    output = inputs / victim
    if how in ("link", "hard link"):
        output = inputs / f"other{output.suffix}"
        output.symlink_to(victim) if how == "link" else output.hardlink_to(inputs / victim)
    overwrite = [] if how == "without --overwrite" else ["--overwrite"]
    needed = ["-o", tmp_path / "out"] if name in ("compare", "convert", "merge") and option != "--output" else []
    try:
        refused(monkeypatch, capsys, inputs, [name, *words, *needed, option, output, *overwrite], victim)
    finally:
        if how in ("link", "hard link"):
            output.unlink()


COMPANIONS = [  # what is written beside the output, and under temporary names
    ("infer dem.tif checkpoint.h5 -o dem.h5", "dem.tif", "--geotiff"),
    ("infer dem.tif checkpoint.h5 -o dem.h5 --resume", "dem.tif", "--geotiff"),
    ("train x.resume.h5 -o x.h5", "x.resume.h5", "--output"),
    ("train pairs.h5 --extend x.resume.h5 -o x.h5", "x.resume.h5", "--output"),
    ("render svbrdf.h5 --camera camera.png --sun-azimuth 9 --sun-elevation 9 -o camera.exr", "camera.png", "--output"),
    ("render --dem dem.tif --model lambert --sun-azimuth 9 --sun-elevation 9 -o dem.exr", "dem.tif", "--output"),
    ("simulate --recipe dem/record.json -o dem", "record.json", "--output"),
    ("match match_sift_1.png measured.png --matcher sift --figures .", "match_sift_1.png", "--figures"),
    ("evaluate pairs.h5 x.json -o x.h5", "x.json", "--output"),
    ("evaluate errors.png checkpoint.h5 -o x.h5 --figures .", "errors.png", "--figures"),
    ("compare comparison.json -o . --models M1,M2", "comparison.json", "--output"),
    ("sample .x.h5.lock -o x.h5", ".x.h5.lock", "--output"),
    ("sample .x.h5.run -o x.h5", ".x.h5.run", "--output"),
    ("sample .x.h5.partial-7.h5 -o x.h5", ".x.h5.partial-7.h5", "--output"),
    ("sample x.h5.parts/scene.h5 -o x.h5", "scene.h5", "--output"),
]


@pytest.mark.parametrize(("line", "victim", "option"), COMPANIONS, ids=[line for line, _, _ in COMPANIONS])
def test_nothing_beside_an_output_replaces_an_input(monkeypatch, capsys, inputs, tmp_path, line, victim, option):
    words = line.split()
    for word in words[1:]:
        source = inputs / word
        made = tmp_path / word
        made.parent.mkdir(exist_ok=True)
        if source.is_file():
            shutil.copy(source, made)
        elif Path(word).suffix in (".h5", ".png", ".json", ".lock", ".run") and words[words.index(word) - 1] != "-o":
            shutil.copy(inputs / ("recipe.json" if word.endswith("json") else "scene.h5"), made)
    said = refused(monkeypatch, capsys, tmp_path, [*words, "--overwrite"], victim)
    assert option in said


def test_the_geotiff_of_a_merged_map_does_not_replace_a_part(monkeypatch, capsys, hilly_map, tmp_path):
    hilly_map[0].rename(tmp_path / "x.tif")
    refused(monkeypatch, capsys, tmp_path, ["merge", "x.tif", "-o", "x.h5", "--overwrite"], "x.tif")


def test_the_parts_behind_a_virtual_artefact_are_inputs(monkeypatch, capsys, inputs, tmp_path):
    """A view reads from its parts: to write over one would change the view without a word."""
    from stages import merge, project, sample

    sample.run(inputs / "scene.h5", tmp_path / "crops.h5", sample.Config(count=20, tile_m=1280, seed=3))
    for k in range(2):
        project.run(tmp_path / "crops.h5", tmp_path / f"part{k}.h5", project.Config(shard=(k, 2)))
    merge.run([tmp_path / "part0.h5", tmp_path / "part1.h5"], tmp_path / "whole.h5", merge.Config(virtual=True))
    refused(monkeypatch, capsys, tmp_path, ["train", "whole.h5", "-o", "part1.h5", "--overwrite"], "part1.h5")


def test_an_output_that_nobody_declared_cannot_replace_anything(tmp_path):
    """A new stage whose author forgot: it replaces neither an input nor another file, whatever it was told."""

    @runner.stage()
    def run(source: Path, output: Output | Path, config: None) -> None:
        write_json(source.with_name(name), 1)

    for name in ("source", "other"):
        for path in (tmp_path / "source", tmp_path / "other"):
            path.write_text("kept")
        with pytest.raises(ConfigError, match="would replace" if name == "source" else "exists already"):
            run(tmp_path / "source", Output(tmp_path / "output", overwrite=True), None)
        assert (tmp_path / name).read_text() == "kept"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other", "source"]


def test_an_output_that_exists_is_refused_before_the_work(tmp_path):
    @runner.stage()
    def run(source: Path, output: Output | Path, config: None) -> None:
        raise AssertionError("worked for nothing")

    for name in ("source", "output"):
        (tmp_path / name).write_text("kept")
    with pytest.raises(ConfigError, match="exists already"):
        run(tmp_path / "source", tmp_path / "output", None)
    with pytest.raises(AssertionError, match="worked"):
        run(tmp_path / "source", Output(tmp_path / "output", overwrite=True), None)


LONG = "n" * 300


@pytest.mark.parametrize(
    "words",
    [
        ["inspect", LONG],
        ["replay", LONG],
        ["sample", LONG],
        ["sample", "d/" * 2100 + "scene.h5"],
        ["ingest", "dem.tif", "--images", LONG],
        ["sample", "scene.h5", "-o", LONG],
        ["sample", "scene.h5", "-o", "n" * 240],  # itself short enough, but not under its temporary name
        ["sample", "scene.h5", "-o", "n" * 252 + ".h5"],
        ["sample", "scene.h5", "-o", "."],
        ["sample", "scene.h5", "-o", "/"],
        ["sample", "scene.h5", "-o", ""],
        ["models", "--json", LONG],
        ["ingest", "dem.tif", "--images", "images.csv"],
        ["ingest", "dem.tif", "--images", "cameras.csv"],
    ],
    ids=lambda words: " ".join(words)[:40],
)
def test_a_name_that_no_file_can_have_is_one_line(monkeypatch, capsys, inputs, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    for name in ("dem.tif", "scene.h5"):
        shutil.copy(inputs / name, tmp_path)
    header, first, *_ = (inputs / "images.csv").read_text().splitlines()
    row = dict(zip(header.split(","), first.split(","), strict=True))
    for name, change in (("images.csv", {"path": LONG}), ("cameras.csv", {"camera": LONG})):
        changed = row | change
        (tmp_path / name).write_text(",".join(changed) + "\n" + ",".join(changed.values()) + "\n")
    before = sorted(tmp_path.rglob("*"))
    code, lines = run(monkeypatch, capsys, *words)
    assert code == 3 and len(lines) == 1, lines
    assert sorted(tmp_path.rglob("*")) == before


def test_a_pipe_is_no_raster_and_nobody_waits_for_it(tmp_path):
    """Opening it would wait for who writes into it: `inspect` and `replay` did, for ever."""
    import signal

    from schemas.rasters import raster_kind

    os.mkfifo(tmp_path / "pipe")
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits"))
    signal.alarm(20)
    try:
        assert raster_kind(tmp_path / "pipe") == ""
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
