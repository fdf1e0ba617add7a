"""The whole chain of commands behind an artefact, kept in it, and a script that makes the same bytes again."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import subprocess

import command
import h5py
import pytest
from cluster_scene import LUNARGR, assert_same, environment
from command import outcome as lunargr
from test_schemas import write_pairs

from lunargr_cli.commands import replay
from schemas.command_line import whole_command
from schemas.errors import ArtefactError
from schemas.files.outputs import Output
from schemas.provenance import Step, chain


@pytest.fixture(scope="module")
def made(small_files, tmp_path_factory):
    """scene, crops and pairs by commands, the crops in shards."""
    folder = tmp_path_factory.mktemp("made")

    def run(*arguments):
        done = command.lunargr(*arguments, cwd=folder)
        assert done.returncode == 0, done.stderr

    run("ingest", small_files.dem, "--images", small_files.images, "--gsd", 20, "--crop", 32, "-o", "scene.h5")
    for k in (1, 2):
        run("sample", "scene.h5", "--count", 60, "--tile-m", 1280, "--seed", 3, "--shard", f"{k}/2", "-o", f"c{k}.h5")
    run("merge", "c1.h5", "c2.h5", "-o", "crops.h5")
    run("project", "crops.h5", "--resume", "--output=pairs.h5")
    return folder


def test_the_chain_names_commands_versions_seeds_and_hashes(made, small_files):
    steps = {s.name: s for s in chain(made / "pairs.h5")}
    assert list(steps) == ["dem.tif", "images.csv", "3 images", "scene.h5", "crops.h5", "pairs.h5"]
    assert steps["dem.tif"].record is None
    for name, path in (("dem.tif", small_files.dem), ("crops.h5", made / "crops.h5")):
        assert steps[name].sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert steps["crops.h5"].record["seed"] == 3
    assert (
        steps["crops.h5"].record["command"] == "lunargr sample scene.h5 --count 60 --tile-m 1280 --seed 3 -o crops.h5"
    )
    assert steps["pairs.h5"].record["command"] == "lunargr project crops.h5 --resume --output=pairs.h5"
    code, said = lunargr("inspect", made / "pairs.h5", "--json", made / "i.json")
    assert code == 0 and "lunargr ingest" in said
    assert [s["name"] for s in json.loads((made / "i.json").read_text())["chain"]] == list(steps)


def test_replay_makes_the_same_bytes_after_all_else_is_gone(made, tmp_path):
    kept = tmp_path / "kept.h5"
    (made / "pairs.h5").rename(kept)
    for name in ("scene.h5", "crops.h5", "c1.h5", "c2.h5"):
        (made / name).unlink()
    code, script = lunargr("replay", kept)
    assert code == 0
    binary = tmp_path / "bin"
    binary.mkdir()
    (binary / "lunargr").write_text(f'#!/bin/sh\nexec {LUNARGR[0]} -m lunargr_cli.main "$@"\n')
    (binary / "lunargr").chmod(0o755)
    path = {"PATH": f"{binary}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash"], input=script, env=environment() | path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert_same(kept, made / "pairs.h5")


def step(name, command="", folder="/work", **other):
    record = {"schema": "scene", "history": "", "command": command, "folder": folder, "version": "1", "seed": -1}
    return Step(name, f"sha of {name}", record | {"config": {}, "inputs": []} | other)


@pytest.mark.parametrize(
    "command",
    [
        "touch X",
        "bash -c 'lunargr ingest'",
        "lunargr; touch X",
        "lunargr 'unbalanced",
        "torchrun X.py",
        "torchrun --no-python touch -m lunargr_cli.main",
        "torchrun --nproc-per-node 2 -m X train p.h5",
        "/opt/lunargr ingest",
        "lunargr touch X",
        "lunar\x00gr\n touch X",
    ],
)
def test_replay_prints_commands_of_lunargr_alone(command):
    with pytest.raises(ArtefactError, match="expected a command of lunargr in its record"):
        list(replay.script([step("a.h5", command)]))


def test_what_a_record_says_cannot_leave_its_words(tmp_path):
    """A shell runs the script with a lunargr that shows its words."""
    names = tmp_path / "names"
    names.mkdir()
    hostile = "x\ntouch X\r\u2028\x1b[2J"
    line = "lunargr ingest dem.tif ; touch Y $(touch Z) `touch V` --overwrite -o o"
    steps = [
        Step(f"dem.tif{hostile}", hostile, None),
        step(f"a{hostile}", line, str(names), version=hostile, schema=hostile),
        step("b.h5", folder=hostile, config={"a": hostile}),
    ]
    (tmp_path / "lunargr").write_text("#!/bin/sh\nprintf '%s|' \"$@\" >> ../words\n")
    (tmp_path / "lunargr").chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    script = "\n".join(replay.script(steps))
    done = subprocess.run(["sh"], input=script, env={"PATH": path}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    words = ["ingest", "dem.tif", ";", "touch", "Y", "$(touch", "Z)", "`touch", "V`", "-o", "o", ""]
    assert (tmp_path / "words").read_text() == "|".join(words)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["lunargr", "names", "words"]


@pytest.mark.parametrize(
    "names", [("a\nb.h5", "runs"), ("a\u200db.h5", "runs"), ("ab.h5", "runs\n2"), ("ab.h5", "\x1b[2J")]
)
def test_replay_names_no_other_file_than_the_record(names):
    made, folder = names
    with pytest.raises(ArtefactError, match="expected names without control characters in its record"):
        list(replay.script([step("a.h5", f"lunargr sample {shlex.quote(made)} -o a.h5", folder)]))


def test_replay_keeps_what_is_there_and_works_in_another_folder(tmp_path):
    (tmp_path / "lunargr").write_text('#!/bin/sh\necho "$PWD $*" >> "$LOG"\n')
    (tmp_path / "lunargr").chmod(0o755)
    for name in ("old", "new"):
        (tmp_path / name / "run/more").mkdir(parents=True)
    folder = tmp_path / "old/run"
    (folder / "scene.h5").write_text("made")
    steps = [
        step("scene.h5", "lunargr ingest dem.tif --overwrite", str(folder)),
        step("crops.h5", "lunargr sample ../scene.h5 --output=crops.h5", f"{folder}/more"),
        step("other.h5", "lunargr sample ../scene.h5 --output=crops.h5", f"{folder}/more"),
    ]
    script = "\n".join(replay.script(steps))
    environment = {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "LOG": str(tmp_path / "log")}
    subprocess.run(["sh"], input=script, env=environment, check=True, text=True)
    subprocess.run(
        ["sh", "-s", "../new/run"], input=script, env=environment, check=True, text=True, cwd=tmp_path / "old"
    )
    assert (tmp_path / "log").read_text().splitlines() == [
        f"{folder}/more sample ../scene.h5 --output=crops.h5",
        f"{tmp_path}/new/run ingest dem.tif",
        f"{tmp_path}/new/run/more sample ../scene.h5 --output=crops.h5",
    ]


def test_a_record_beside_a_file_is_a_file(tmp_path):
    """A pipe might never answer, and a device never end."""
    os.mkfifo(tmp_path / "record.json")
    (tmp_path / "dem.tif").write_bytes(b"a DEM")
    assert chain(tmp_path / "dem.tif") == [Step("dem.tif", "", None)]


def test_a_chain_may_be_of_any_length(tmp_path):
    """Each step made from the one before, and from one that all share."""
    count = 3000
    records = {
        f"sha{k}": step(
            f"{k}.h5", inputs=[{"name": "dem.tif", "sha256": "dem"}, {"name": f"{k - 1}.h5", "sha256": f"sha{k - 1}"}]
        ).record
        for k in range(1, count)
    }
    path = write_pairs(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        file.create_dataset("unused", data=0)
        file.attrs["inputs"] = json.dumps([{"name": "last.h5", "sha256": f"sha{count - 1}"}])
        del file.attrs["provenance"]
    with h5py.File(path, "r+", libver="latest") as file:  # whose attributes may be of any size
        file.attrs["provenance"] = json.dumps(records)
    steps = chain(path)
    assert [s.name for s in steps[:4]] == ["dem.tif", "0.h5", "1.h5", "2.h5"]
    assert len(steps) == count + 2 and steps[-2].name == "last.h5"


def test_a_library_run_says_so(small_artefacts):
    code, script = lunargr("replay", small_artefacts["pairs"])
    assert code == 0
    assert script.count("made from Python") == 3
    assert '"tile_m": 1280' in script


def test_a_file_of_another_program_is_where_the_chain_begins(small_artefacts, tmp_path):
    pairs = tmp_path / "pairs.h5"
    pairs.write_bytes(small_artefacts["pairs"].read_bytes())
    with h5py.File(pairs, "r+") as file:
        for name in ("lunargr_schema", "command", "inputs", "provenance"):
            del file.attrs[name]
    options = [
        "--model",
        "lambert",
        "--epochs",
        1,
        "--widths",
        "4-4",
        "--device",
        "cpu",
        "--precision",
        "fp32",
        "--quiet",
    ]
    code, said = lunargr("train", pairs, *options, "-o", tmp_path / "checkpoint.h5")
    assert code == 0, said
    code, script = lunargr("replay", tmp_path / "checkpoint.h5")
    assert code == 0 and "# needs pairs.h5  # sha256" in script
    assert "lunargr train" in script


def test_images_count_as_inputs_together(made, small_files, small_artefacts):
    """One digest for all, which a shell makes again; each image's own is in the scene. However the scene was made."""
    images = [small_files.folder / f"image{k}.tif" for k in range(3)]
    line = ["bash", "-c", 'sha256sum "$@" | cut -c 1-64 | sha256sum', "-", *map(str, images)]
    expected = subprocess.run(line, capture_output=True, text=True, check=True).stdout.split()[0]
    for path in (made / "pairs.h5", small_artefacts["scene"]):
        assert {s.name: s for s in chain(path)}["3 images"].sha256 == expected
    with h5py.File(small_artefacts["scene"]) as file:
        own = [hashlib.sha256(path.read_bytes()).hexdigest() for path in images]
        assert [d.decode() for d in file["sha256"][...]] == own


def test_the_chain_goes_back_to_simulate(tmp_path):
    """Rasters carry no record: it lies beside them, and holds for the contents that it names alone."""
    from stages import ingest

    options = ["--size-px", 160, "--images", 2, "--quiet"]
    code, said = lunargr("simulate", "-o", tmp_path / "s", *options)
    assert code == 0, said
    scene = tmp_path / "scene.h5"
    ingest.run(tmp_path / "s/dem.tif", tmp_path / "s/images.csv", scene, ingest.Config(gsd=5, crop=32))
    steps = {s.name: s for s in chain(scene)}
    for name in ("dem.tif", "images.csv", "2 images"):
        assert steps[name].record["command"].startswith("lunargr simulate -o "), name
    code, script = lunargr("replay", scene)
    assert code == 0 and script.count("] || lunargr simulate -o ") == 1
    with open(tmp_path / "s/images.csv", "a") as table:
        table.write("\n")
    ingest.run(
        tmp_path / "s/dem.tif", tmp_path / "s/images.csv", Output(scene, overwrite=True), ingest.Config(gsd=5, crop=32)
    )
    steps = {s.name: s for s in chain(scene)}
    assert steps["images.csv"].record is None and steps["dem.tif"].record is not None


@pytest.mark.parametrize(
    ("shard", "whole"),
    [
        ("lunargr project c.h5 --shard 1/2 -o p.1.h5", "lunargr project c.h5 -o 'my pairs.h5'"),
        ("lunargr project c.h5 --output=p.1.h5 --shard=1/2 -q", "lunargr project c.h5 -o 'my pairs.h5' -q"),
        ("lunargr project c.h5 --shard 1/2", "lunargr project c.h5 -o 'my pairs.h5'"),
        ("", ""),
    ],
)
def test_the_command_of_the_whole_from_that_of_a_shard(shard, whole, tmp_path):
    from pathlib import Path

    assert whole_command(shard, Path("my pairs.h5")) == whole
