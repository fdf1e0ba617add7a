"""The cluster scripts and the Snakefile: with stand-ins for Slurm and for the stages, and with the real ones."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest
from cluster_scene import assert_same, environment, write_inputs
from conftest import ROOT

SCRIPTS = sorted((ROOT / "examples" / "cluster").glob("*.sh"))
# Slurm's side of the bargain: one job after the other, array tasks with their number, the id on standard output. It takes
# no job with more than 2 GPUs a node, and cancels what waits for a failed job.
SBATCH = """#!/usr/bin/env bash
set -eu
case "$*" in *--gpus-per-node=[3-9]*) echo "allocation failure: Requested node configuration is not available" >&2; exit 1 ;; esac
case "$*" in *--test-only*) exit 0 ;; esac
tasks=1 wrap= script=() waits=
echo "sbatch $*" >> "$FAKE_LOG"
for word in "$@"; do
    case $word in
        --array=*) tasks=${word##*-} ;;
        --dependency=afterok:*) waits=${word##*:} ;;
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
job=$(($(wc -l < "$FAKE_LOG") + 100))
echo $job
if [ -n "$waits" ] && [ -e "$FAKE_LOG.failed.$waits" ]; then touch "$FAKE_LOG.failed.$job"; exit 0; fi
for ((i = 1; i <= tasks; i++)); do
    if [ -n "$wrap" ]; then
        SLURM_ARRAY_TASK_ID=$i bash -c "$wrap" >> "$FAKE_LOG.said" 2>&1 || touch "$FAKE_LOG.failed.$job"
    else
        bash "${script[@]}" >> "$FAKE_LOG.said" 2>&1 || touch "$FAKE_LOG.failed.$job"
    fi
done
"""
SQUEUE = '#!/bin/sh\n[ ! -e "$FAKE_LOG.queue" ] || cat "$FAKE_LOG.queue"\n'
# A stage that only makes its output. BROKEN is the name of one that fails.
STAND_IN = """#!/bin/sh
echo "lunargr $*" >> "$FAKE_LOG.stages"
while [ $# -gt 0 ]; do case $1 in --output | -o) output=$2 ;; esac; shift; done
[ "$(basename "$output")" != "${BROKEN:-}" ] || exit 3
[ ! -e "$output" ] || { echo "$output: exists already" >&2; exit 3; }
touch "$output"
"""


@pytest.fixture
def shell(tmp_path):
    """Environment with stand-ins for `sbatch` and `squeue`, and the real commands, on the path."""
    folder = tmp_path / "bin"
    folder.mkdir()
    real = {"lunargr": "lunargr_cli.main", "torchrun": "torch.distributed.run", "dask": "dask"}
    texts = {name: f'#!/bin/sh\nexec {sys.executable} -m {module} "$@"\n' for name, module in real.items()}
    for name, text in (texts | {"sbatch": SBATCH, "squeue": SQUEUE}).items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    path = f"{folder}{os.pathsep}{os.environ['PATH']}"
    return environment() | {"PATH": path, "FAKE_LOG": str(tmp_path / "log")}


@pytest.fixture
def stand_in(shell, tmp_path):
    """The same with stand-ins for the stages."""
    for name in ("lunargr", "torchrun"):
        (tmp_path / "bin" / name).write_text(STAND_IN)
    return shell | {"SHARDS": "3", "IMAGE_SHARDS": "2", "GPUS": "0"}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_scripts_parse_and_explain_themselves(script):
    assert subprocess.run(["bash", "-n", script]).returncode == 0
    if shutil.which("shellcheck"):
        assert subprocess.run(["shellcheck", "-x", "-S", "warning", script]).returncode == 0
    said = subprocess.run(["bash", script], capture_output=True, text=True)
    assert said.returncode == 2 and f"examples/cluster/{script.name}" in said.stderr


def run(script, arguments, env, folder):
    command = ["bash", ROOT / "examples" / "cluster" / script, *map(str, arguments)]
    return subprocess.run(command, env=env, cwd=folder, capture_output=True, text=True)


def succeed(script, arguments, env, folder):
    done = run(script, arguments, env, folder)
    log = Path(env["FAKE_LOG"] + ".said")
    assert done.returncode == 0, done.stderr + (log.read_text() if log.exists() else "")
    return done


def count_jobs(env) -> int:
    return Path(env["FAKE_LOG"]).read_text().count("sbatch ")


FILES = ["dem.tif", "images.csv", "run"]
MADE = [
    "calibration.json",
    "checkpoint.h5",
    "crops.h5",
    "evaluation.h5",
    "grid.h5",
    "pairs.h5",
    "scene.h5",
    "svbrdf.h5",
    "svbrdf_albedo.h5",
]


def test_a_failed_task_ends_the_chain_and_the_same_line_makes_what_is_missing(stand_in, tmp_path):
    succeed("slurm_pipeline.sh", FILES, stand_in | {"BROKEN": "pairs.2-of-3.h5"}, tmp_path)
    assert count_jobs(stand_in) == 15  # six arrays with their merges, training, calibration, evaluation
    left = ["crops.h5", "grid.h5", "pairs.1-of-3.h5", "pairs.3-of-3.h5", "scene.h5"]
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == left
    succeed("slurm_pipeline.sh", FILES, stand_in, tmp_path)
    assert count_jobs(stand_in) == 15 + 9
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == MADE
    succeed("slurm_pipeline.sh", FILES, stand_in, tmp_path)
    assert count_jobs(stand_in) == 15 + 9  # all is there
    stages = (tmp_path / "log.stages").read_text().splitlines()
    assert sum("--output run/pairs.1-of-3.h5" in line for line in stages) == 1
    calibrated = [line for line in stages if "--calibration run/calibration.json" in line]
    assert len(calibrated) == 3 and all(" --shard " in line for line in calibrated)
    assert any(" --model hapke " in line for line in stages)


@pytest.mark.parametrize("how", ["one_machine.sh", "Makefile.pipeline"])
def test_one_machine_makes_what_is_missing(stand_in, tmp_path, how):
    for name in FILES[:2]:
        (tmp_path / name).touch()
    words = ["bash", ROOT / "examples" / "cluster" / how, *FILES, "3"]
    if how == "Makefile.pipeline":
        words = ["make", "-f", ROOT / "examples" / how, "DEM=dem.tif", "IMAGES=images.csv", "OUT=run", "N=3"]
    broken = subprocess.run(words, env=stand_in | {"BROKEN": "pairs.2-of-3.h5"}, cwd=tmp_path, capture_output=True)
    assert broken.returncode != 0 and not (tmp_path / "run" / "pairs.h5").exists()
    done = subprocess.run(words, env=stand_in, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {"calibration.json", "evaluation.h5", "svbrdf_albedo.h5"} <= {p.name for p in (tmp_path / "run").iterdir()}


def test_what_slurm_refuses_is_told_before_the_first_job(stand_in, tmp_path):
    done = run("slurm_pipeline.sh", FILES, stand_in | {"GPUS": "4"}, tmp_path)
    assert done.returncode == 1 and "nothing was submitted" in done.stderr and "--gpus-per-node=4" in done.stderr
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize("queued, refused", [("run", True), ("run2", False)])
def test_a_second_chain_beside_one_in_the_queue_is_refused(stand_in, tmp_path, queued, refused):
    (tmp_path / "log.queue").write_text(f"17 lunargr {tmp_path}/{queued}/pairs.h5\n18 (null)\n")
    done = run("slurm_pipeline.sh", FILES, stand_in, tmp_path)
    assert done.returncode == (1 if refused else 0), done.stderr
    if refused:
        assert "scancel 17" in done.stderr and "18" not in done.stderr
        assert not (tmp_path / "log").exists()


def test_a_dry_run_shows_the_chain(stand_in, tmp_path):
    done = succeed("slurm_pipeline.sh", FILES, stand_in | {"DRY_RUN": "1", "REGISTER": "field"}, tmp_path)
    lines = [line for line in done.stderr.splitlines() if line.startswith("sbatch")]
    assert len(lines) == 15
    assert all("--dependency=afterok" in line and "--kill-on-invalid-dep=yes" in line for line in lines[1:])
    assert sum("--register\\ field" in line or "--register field" in line for line in lines) == 3
    assert not (tmp_path / "log").exists()


def small_settings(**more):
    settings = {"SHARDS": 3, "IMAGE_SHARDS": 5, "GSD": 20, "CROP": 32, "COUNT": 90, "SEED": 3, "EPOCHS": 1, "CPUS": 1}
    return {k: str(v) for k, v in (settings | {"GPUS": 0, "MODEL": "M2"} | more).items()}


@pytest.mark.slow
def test_the_pipeline_s_jobs_make_what_one_machine_makes(shell, tmp_path):
    paths = write_inputs(tmp_path / "one")
    succeed("slurm_pipeline.sh", [paths["dem"], paths["images"], "run"], shell | small_settings(), tmp_path)
    assert_same(paths["scene"], tmp_path / "run" / "scene.h5")
    with h5py.File(tmp_path / "run" / "pairs.h5") as a, h5py.File(tmp_path / "run" / "svbrdf_albedo.h5") as b:
        assert a["elevation"].shape == (90, 32, 32)
        assert b["valid"][...].mean() > 0.9 and len(b["albedo_gain"]) == 3
    assert (tmp_path / "run" / "evaluation.json").exists()


def on_slurm(*words):
    return subprocess.run(words, check=True, capture_output=True, text=True, timeout=60).stdout


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("sinfo") is None or not os.environ.get("SLURM_CONF"), reason="needs a Slurm, in SLURM_CONF"
)
def test_a_killed_task_and_a_requeue_on_a_real_slurm(tmp_path):
    """The paths of this machine, so that jobs find the package; nothing stands in."""
    paths = write_inputs(tmp_path / "one")
    command = Path(sys.executable).with_name("lunargr")
    env = environment() | small_settings(MEM="3G", TRAIN_OPTIONS="--cpus-per-task=1 --mem=3G", LUNARGR=command)
    arguments = [paths["dem"], paths["images"], "run"]

    def submit():
        assert run("slurm_pipeline.sh", arguments, env, tmp_path).returncode == 0
        assert "scancel" in run("slurm_pipeline.sh", arguments, env, tmp_path).stderr

    def wait_for(name):
        while not (jobs := on_slurm("squeue", "-h", "-r", "-t", "R", "-n", name, "-o", "%i").split()):
            assert on_slurm("squeue", "-h"), "the queue is empty"
            time.sleep(0.2)
        return jobs[0]

    submit()
    on_slurm("scancel", "--signal=KILL", "--full", wait_for("lunargr-ingest"))
    while on_slurm("squeue", "-h"):  # what waited for it goes, too
        time.sleep(1)
    assert not (tmp_path / "run" / "grid.h5").exists()
    submit()
    on_slurm("scontrol", "requeue", wait_for("lunargr-merge-ingest"))
    on_slurm("scontrol", "requeue", wait_for("lunargr-train"))
    while on_slurm("squeue", "-h"):
        time.sleep(1)
    assert {p.name for p in (tmp_path / "run").glob("*.*") if p.name in MADE} == set(MADE)
    assert_same(paths["scene"], tmp_path / "run" / "scene.h5")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("snakemake") is None, reason="needs Snakemake on the path")
def test_the_snakefile_makes_what_is_missing(stand_in, tmp_path):
    for name in FILES[:2]:
        (tmp_path / name).touch()
    words = ["snakemake", "-s", ROOT / "examples" / "Snakefile", "--cores", "2", "--retries", "0"]
    words += ["--rerun-incomplete", "--config", "shards=3", "image_shards=2"]
    broken = subprocess.run(words, env=stand_in | {"BROKEN": "pairs.2-of-3.h5"}, cwd=tmp_path, capture_output=True)
    assert broken.returncode != 0 and not (tmp_path / "run" / "pairs.h5").exists()
    assert subprocess.run(words, env=stand_in, cwd=tmp_path, capture_output=True).returncode == 0
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == MADE
    stages = (tmp_path / "log.stages").read_text().splitlines()
    assert sum("run/scene.1-of-2.h5" in line and "merge" not in line for line in stages) == 1


@pytest.mark.slow
def test_a_dask_cluster_of_its_own(shell, small_artefacts, tmp_path):
    pytest.importorskip("distributed")
    command = ["project", small_artefacts["crops"], "--parts", 4, "-o", tmp_path / "pairs.h5"]
    succeed("dask.sh", command, shell | {"TMPDIR": str(tmp_path)}, tmp_path)
    assert_same(small_artefacts["pairs"], tmp_path / "pairs.h5")
    assert not list(tmp_path.glob("lunargr-dask.*"))
