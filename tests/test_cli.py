"""The command line: help that a stranger understands, exit code 3 with one line, nothing half-written."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from command import lunargr

STAGES = [
    "simulate",
    "ingest",
    "sample",
    "project",
    "train",
    "infer",
    "albedo",
    "refine",
    "normalize",
    "render",
    "evaluate",
    "match",
    "diagnose",
    "inspect",
    "replay",
    "schema",
    "merge",
]


def test_every_stage_has_a_command():
    out = lunargr("--help").stdout
    for stage in STAGES:
        assert f"  {stage} " in out


def test_the_list_of_commands_cuts_no_sentence_off(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    out = lunargr("--help").stdout
    assert "..." not in out.split("Commands:")[1]
    assert "Learn reflectance from terrain through the differentiable renderer" in " ".join(out.split())
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("stage", STAGES)
def test_help_explains_every_option(stage):
    from typer.main import get_command

    from lunargr_cli.main import app

    command = get_command(app).commands[stage]
    assert command.help
    for parameter in command.params:
        if parameter.param_type_name == "option" and parameter.name != "help":
            assert parameter.help, f"{stage} --{parameter.name}"


def refused(result, folder, before):
    """Exit code 3, one line on standard error, and no new file."""
    assert result.returncode == 3, result
    lines = [line for line in result.stderr.splitlines() if line.startswith("lunargr:")]
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert sorted(folder.rglob("*")) == before
    return lines[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["ingest", "absent.tif", "-o", "x.h5"], "absent.tif: no such file"),
        (["sample", "text.h5", "-o", "x.h5"], "another kind of file"),
        (["project", "scene.h5", "-o", "x.h5"], "expected a 'crops'"),
        (["train", "crops.h5"], "expected a 'pairs'"),
        (["train", "pairs.h5", "--model", "M77"], "choose one of"),
        (["infer", "scene.h5", "pairs.h5"], "expected a 'checkpoint'"),
        (["infer", "absent.h5", "pairs.h5"], "no such file"),
        (["sample", "scene.h5", "-o", "crops.h5"], "--overwrite"),
        (["sample", "scene.h5", "-o", "scene.h5", "--overwrite"], "replace the input"),
        (["sample", "scene.h5", "--shard", "4/3", "-o", "x.h5"], "--shard"),
        (["sample", "scene.h5", "--split", "a/b", "-o", "x.h5"], "--split"),
        (["merge", "crops.h5", "pairs.h5", "-o", "x.h5"], "expected a 'crops'"),
        (["inspect", "text.h5"], "another kind of file"),
        (["schema", "nothing"], "choose one of"),
        (["ingest", "text.h5", "--body", "pluto2", "-o", "x.h5"], "expected a radius"),
    ],
)
def test_bad_input_is_one_line_and_exit_3(small_artefacts, tmp_path, arguments, words):
    for name, path in small_artefacts.items():
        (tmp_path / f"{name}.h5").symlink_to(path)
    (tmp_path / "text.h5").write_text("no HDF5")
    before = sorted(tmp_path.rglob("*"))
    line = refused(lunargr(*arguments, cwd=tmp_path), tmp_path, before)
    assert words in line


def test_inspect_says_what_made_a_file_and_from_what(small_artefacts, tmp_path):
    result = lunargr("inspect", small_artefacts["pairs"], "--json", tmp_path / "i.json")
    assert result.returncode == 0
    assert "'pairs'" in result.stdout
    found = json.loads((tmp_path / "i.json").read_text())
    sources = [s["name"] for s in json.loads(found["attributes"]["inputs"])]
    assert sources == ["crops.h5", "scene.h5"]
    assert found["variables"]["elevation"]["dims"] == ["pair", "y", "x"]


def test_usage_errors_keep_click_s_exit_code():
    assert lunargr("sample").returncode == 2
    assert lunargr("sample", "scene.h5", "--no-such-option").returncode == 2


def test_version_is_that_of_the_package():
    from importlib.metadata import version

    done = subprocess.run(
        [sys.executable, "-m", "lunargr_cli.main", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == f"lunargr {version('lunargr')}" and not done.stderr


@pytest.mark.parametrize(
    ("command", "names"),
    [
        (["match", "--list"], ["daisy", "sift", "--features-model"]),
        (["models", "--cameras"], ["pinhole", "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"]),
    ],
)
def test_registries_are_listed(command, names, monkeypatch):
    """What a user may choose from, files that were added among it."""
    monkeypatch.setenv("COLUMNS", "200")
    result = lunargr(*command)
    assert result.returncode == 0 and all(name in result.stdout for name in names)


def test_match_without_files_says_what_to_give():
    result = lunargr("match")
    assert result.returncode == 3 and "give pairs.h5 and checkpoint.h5, or --list" in result.stderr


REFUSED_AT_ONCE = """import os, sys
from lunargr_cli.main import main
os._exit = sys.exit
for words in (
    ["train", "absent.h5"],
    ["train", sys.executable, "--schedule", "cos"],
    ["train", sys.executable, "--model", "M77"],
    ["diagnose", sys.executable, "--model", "M77"],
    ["compare", sys.executable, "--models", "M1,M77", "-o", "x"],
    ["render", "--dem", sys.executable, "--model", "M77", "-o", "x.exr"],
    ["render", "--dem", sys.executable, "--model", "hapke", "-o", "x.exr"],
):
    sys.argv = ["lunargr", *words]
    try:
        main()
    except SystemExit as stop:
        print(stop.code, {"torch", "numba"} & set(sys.modules))
"""


def test_a_missing_file_sun_or_unknown_name_is_refused_before_a_stage_is_imported(tmp_path):
    """Whose import takes seconds."""
    done = subprocess.run([sys.executable, "-c", REFUSED_AT_ONCE], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.splitlines() == 7 * ["3 set()"], done.stderr
    assert "absent.h5: no such file" in done.stderr and "--sun-azimuth" in done.stderr
    assert done.stderr.count("unknown reflectance model 'M77'") == 4


@pytest.mark.parametrize("words", ["train pairs.h5", "diagnose pairs.h5", "render --dem dem.tif"])
def test_the_shell_completes_models(words, monkeypatch):
    line = f"lunargr {words} --model hapke_l"
    monkeypatch.setenv("_LUNARGR_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split()) - 1))
    assert lunargr().stdout.split() == ["hapke_legendre", "hapke_legendre_h1981"]
