"""The cluster scripts, run with a `sbatch` that works its jobs off at once: arrays, merges, a requeued training, Dask."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import h5py
import pytest
from cluster_scene import LUNARGR, assert_same, environment, write_inputs
from conftest import ROOT

SCRIPTS = sorted((ROOT / "examples" / "cluster").glob("*.sh"))
# Slurm's side of the bargain: one job after the other, array tasks with their number, the id on standard output.
SBATCH = """#!/usr/bin/env bash
set -eu
tasks=1 wrap= script=()
echo "sbatch $*" >> "$FAKE_LOG"
for word in "$@"; do
    case $word in
        --array=*) tasks=${word##*-} ;;
    esac
done
while [ $# -gt 0 ]; do
    case $1 in
        --wrap) wrap=$2; shift ;;
        -*) ;;
        *) script=("$@"); break ;;
    esac
    shift
done
for ((i = 1; i <= tasks; i++)); do
    if [ -n "$wrap" ]; then
        SLURM_ARRAY_TASK_ID=$i bash -c "$wrap" >> "$FAKE_LOG" 2>&1
    else
        bash "${script[@]}" >> "$FAKE_LOG" 2>&1
    fi
done
echo 4711
"""


@pytest.fixture
def shell(tmp_path):
    """Environment with `sbatch` and `lunargr` on the path."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, text in (("sbatch", SBATCH), ("lunargr", f'#!/bin/sh\nexec {LUNARGR[0]} -m lunargr_cli.main "$@"\n')):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    path = f"{folder}{os.pathsep}{os.environ['PATH']}"
    return environment() | {"PATH": path, "FAKE_LOG": str(tmp_path / "log"), "LUNARGR_PYTHON": sys.executable}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_scripts_parse_and_explain_themselves(script):
    assert subprocess.run(["bash", "-n", script]).returncode == 0
    if shutil.which("shellcheck"):
        assert subprocess.run(["shellcheck", "-S", "warning", script]).returncode == 0
    said = subprocess.run(["bash", script], capture_output=True, text=True)
    assert said.returncode == 2 and f"examples/cluster/{script.name}" in said.stderr


def run(script, arguments, env, folder):
    command = ["bash", ROOT / "examples" / "cluster" / script, *map(str, arguments)]
    done = subprocess.run(command, env=env, cwd=folder, capture_output=True, text=True)
    log = folder / "log"
    assert done.returncode == 0, done.stderr + (log.read_text() if log.exists() else "")
    return done


@pytest.mark.slow
def test_the_pipeline_s_jobs_make_what_one_machine_makes(shell, tmp_path):
    paths = write_inputs(tmp_path / "one")
    settings = {"SHARDS": 3, "IMAGE_SHARDS": 2, "GSD": 20, "CROP": 32, "COUNT": 90, "SEED": 3, "EPOCHS": 1, "CPUS": 1}
    env = shell | {k: str(v) for k, v in settings.items()}
    run("slurm_pipeline.sh", [paths["dem"], paths["images"], tmp_path / "run"], env, tmp_path)
    assert_same(paths["scene"], tmp_path / "run" / "scene.h5")
    with h5py.File(tmp_path / "run" / "pairs.h5") as a, h5py.File(tmp_path / "run" / "svbrdf.h5") as b:
        assert a["elevation"].shape == (90, 32, 32)
        assert b["valid"][...].mean() > 0.9
    assert (tmp_path / "run" / "evaluation.json").exists()
    submitted = (tmp_path / "log").read_text().count("sbatch ")
    run("slurm_pipeline.sh", [paths["dem"], paths["images"], tmp_path / "run"], env, tmp_path)
    assert (tmp_path / "log").read_text().count("sbatch ") == submitted  # all is there


def test_a_dry_run_shows_the_chain(shell, tmp_path):
    done = run("slurm_pipeline.sh", ["dem.tif", "images.csv", tmp_path / "run"], shell | {"DRY_RUN": "1"}, tmp_path)
    lines = [line for line in done.stderr.splitlines() if line.startswith("sbatch")]
    assert len(lines) == 12  # five arrays with their merges, training, evaluation
    assert all("--dependency=afterok" in line for line in lines[1:])
    assert not (tmp_path / "log").exists()


@pytest.mark.slow
def test_a_dask_cluster_of_its_own(shell, small_artefacts, tmp_path):
    pytest.importorskip("distributed")
    command = ["project", small_artefacts["crops"], "--parts", 4, "-o", tmp_path / "pairs.h5"]
    run("dask.sh", command, shell | {"TMPDIR": str(tmp_path)}, tmp_path)
    assert_same(small_artefacts["pairs"], tmp_path / "pairs.h5")
    assert not list(tmp_path.glob("lunargr-dask.*"))
