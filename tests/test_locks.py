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
from schemas.locks import SILENCE, claim, host, lock_path, unlocked


def hold(path, seconds=60):
    """Another process that holds an output's lock."""
    code = f"import time; from pathlib import Path; from schemas.locks import claim\nwith claim(Path({str(path)!r})):\n print('held', flush=True); time.sleep({seconds})"
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
    silent = time.time() - SILENCE - 5
    os.utime(lock, (silent, silent))
    with claim(output):
        assert json.loads(lock.read_text())["host"] == host()


def test_a_number_that_another_process_has_now_is_no_owner(tmp_path):
    write_lock(tmp_path / "x.h5", pid=os.getpid(), began=1.0)
    with claim(tmp_path / "x.h5"):
        pass


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


def _take(path, out):
    try:
        with claim(path):
            out.put("got it")
            time.sleep(1.0)
    except ConfigError:
        out.put("refused")


def test_one_of_many_takes_over_a_stale_lock(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    write_lock(tmp_path / "x.h5", pid=dead.pid)
    context = multiprocessing.get_context("fork")
    out = context.Queue()
    many = [context.Process(target=_take, args=(tmp_path / "x.h5", out)) for _ in range(6)]
    for process in many:
        process.start()
    answers = sorted(out.get(timeout=20) for _ in many)
    for process in many:
        process.join()
    assert answers == ["got it"] + ["refused"] * 5
