"""Two runs on one output: the second says so and stops; locks of dead runs are taken over, once."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest

from schemas import ConfigError, atomic_path
from schemas.files.companions import companions_of
from schemas.files.locks import STALE_AFTER, claim, host, lock_path, unlocked


def hold(path, seconds=60):
    """Another process that holds an output's lock."""
    code = f"import time; from pathlib import Path; from schemas.files.locks import claim\nwith claim(Path({str(path)!r})):\n print('held', flush=True); time.sleep({seconds})"
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "held\n"
    return other


def write_lock(path, **change):
    owner = {"host": host(), "pid": os.getpid(), "began": None, "since": "2026-01-01 00:00:00"} | change
    lock_path(path).write_text(json.dumps(owner))
    return lock_path(path)


def test_the_second_run_says_so_and_stops(small_artefacts, tmp_path):
    output = tmp_path / "crops.h5"
    other = hold(output)
    command = [sys.executable, "-m", "lunargr_cli.main", "sample", small_artefacts["scene"], "-o", output]
    try:
        second = subprocess.run(command, capture_output=True, text=True)
        assert second.returncode == 3
        assert second.stderr.splitlines() == [line for line in second.stderr.splitlines() if "another run" in line]
        assert f"process {other.pid} on {host()}" in second.stderr
        assert not output.exists()
        with pytest.raises(ConfigError, match="another run"), atomic_path(output):
            raise AssertionError("both write")
    finally:
        other.send_signal(signal.SIGKILL)
        other.communicate()
    (tmp_path / ".crops.partial-node-17-17.h5").write_text("what the killed run left")
    third = subprocess.run([*command, "--count", "20"], capture_output=True, text=True)
    assert third.returncode == 0, third.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["crops.h5"]


def test_one_process_may_claim_again_and_lets_go_at_the_end(tmp_path):
    output = tmp_path / "x.h5"
    with claim(output):
        with atomic_path(output) as partial:
            partial.write_text("whole")
        assert lock_path(output).exists()
    assert output.read_text() == "whole"
    assert not lock_path(output).exists()


def test_a_lock_of_another_machine_holds_until_it_was_silent_for_long(tmp_path):
    output = tmp_path / "x.h5"
    lock = write_lock(output, host="elsewhere")
    with pytest.raises(ConfigError, match="on elsewhere"), claim(output):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == [lock.name]
    silent = time.time() - STALE_AFTER - 5
    os.utime(lock, (silent, silent))
    with claim(output):
        assert json.loads(lock.read_text())["host"] == host()


def test_a_number_that_another_process_has_now_is_no_owner(tmp_path):
    write_lock(tmp_path / "x.h5", pid=os.getpid(), began=1.0)
    with claim(tmp_path / "x.h5"):
        assert json.loads(lock_path(tmp_path / "x.h5").read_text())["began"] != 1.0
    assert not lock_path(tmp_path / "x.h5").exists()


def test_a_lock_that_never_got_its_name_is_stale_after_a_while(tmp_path):
    lock = lock_path(tmp_path / "x.h5")
    lock.touch()
    with pytest.raises(ConfigError, match="just started"), claim(tmp_path / "x.h5"):
        pass
    os.utime(lock, (time.time() - 60,) * 2)
    with claim(tmp_path / "x.h5"):
        pass


def test_parts_of_a_run_whose_driver_holds_the_lock_are_not_locked(tmp_path):
    write_lock(tmp_path / "x.h5", host="elsewhere")
    with unlocked(), atomic_path(tmp_path / "x.h5") as partial:
        partial.write_text("part")
    assert (tmp_path / "x.h5").read_text() == "part"


def _take(path, out, everyone_answered):
    try:
        with claim(path):
            out.put("got it")
            everyone_answered.wait(20)
    except ConfigError:
        out.put("refused")


def test_one_of_many_takes_over_a_stale_lock(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    write_lock(tmp_path / "x.h5", pid=dead.pid)
    context = multiprocessing.get_context("fork")
    out, everyone_answered = context.Queue(), context.Event()
    many = [context.Process(target=_take, args=(tmp_path / "x.h5", out, everyone_answered)) for _ in range(6)]
    for process in many:
        process.start()
    answers = sorted(out.get(timeout=20) for _ in many)
    everyone_answered.set()
    for process in many:
        process.join()
    assert answers == ["got it"] + ["refused"] * 5


KILLED = """
import os, signal, sys
from pathlib import Path
from schemas import atomic_path
from schemas.files.companions import companions_of
from schemas.files.locks import claim
output = Path(sys.argv[1])
with claim(output), companions_of(output):
    for name in ("map.tif", "map.png"):
        with atomic_path(output.with_name(name)) as partial:
            partial.write_text("of the killed run")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_belongs_to_an_output_goes_with_a_run_that_was_killed_before_it(tmp_path):
    output, tiff, png = (tmp_path / name for name in ("map.h5", "map.tif", "map.png"))
    assert subprocess.run([sys.executable, "-c", KILLED, output], check=False).returncode == -signal.SIGKILL
    assert sorted(p.name for p in tmp_path.iterdir()) == [".map.h5.lock", "map.png", "map.tif"]
    png.unlink()
    png.write_text("somebody's own")
    with claim(output):
        assert not tiff.exists()
        assert png.read_text() == "somebody's own"
    assert [p.name for p in tmp_path.iterdir()] == ["map.png"]


@pytest.mark.parametrize("whole", [False, True])
def test_what_belongs_to_an_output_goes_with_a_run_that_fails_before_it(tmp_path, whole):
    output, tiff, before = tmp_path / "map.h5", tmp_path / "map.tif", tmp_path / "before.tif"
    before.write_text("there before")
    with pytest.raises(KeyboardInterrupt), claim(output):
        with companions_of(output):
            for path in (tiff, before):  # the second replaces a file
                with atomic_path(path) as partial:
                    partial.write_text("new")
        if whole:
            with atomic_path(output) as partial:
                partial.write_text("whole")
        raise KeyboardInterrupt
    assert tiff.exists() == whole
    assert before.read_text() == "new"
    assert not lock_path(output).exists()


def test_files_that_belong_to_nothing_stay(tmp_path):
    with pytest.raises(KeyboardInterrupt), claim(tmp_path / "checkpoint.h5"):
        with atomic_path(tmp_path / "epoch.h5") as partial:
            partial.write_text("an epoch")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["epoch.h5"]
