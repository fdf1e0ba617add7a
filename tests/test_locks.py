"""Two runs on one output: the second says so and stops; what a dead run left behind is no obstacle."""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from unittest import mock

import filelock
import pytest

from schemas import ConfigError, atomic_path, write_json
from schemas.files.companions import companions_of
from schemas.files.inputs import Inputs
from schemas.files.locks import claim, lock_path, partial_path, record_path, scratch_path, unlocked
from schemas.files.outputs import Target, protect

NO_FLOCK = """
import errno, fcntl, warnings
def flock(number, how): raise OSError(errno.ENOSYS, 'no locks')
fcntl.flock = flock
warnings.simplefilter('ignore')
"""


def hold(path, before="", seconds=60):
    """Another process that holds an output's lock."""
    code = f"{before}\nimport time; from pathlib import Path; from schemas.files.locks import claim\nwith claim(Path({str(path)!r})):\n print('held', flush=True); time.sleep({seconds})"
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "held\n"
    return other


def test_the_second_run_says_so_and_stops(small_artefacts, tmp_path):
    output = tmp_path / "crops.h5"
    other = hold(output)
    command = [sys.executable, "-m", "lunargr_cli.main", "sample", small_artefacts["scene"], "-o", output]
    try:
        second = subprocess.run(command, capture_output=True, text=True)
        assert second.returncode == 3
        assert len(second.stderr.splitlines()) == 1
        assert f"another run is writing this output (process {other.pid} on " in second.stderr
        assert not output.exists()
        with pytest.raises(ConfigError, match="another run"), atomic_path(output):
            raise AssertionError("both write")
    finally:
        other.send_signal(signal.SIGKILL)
        other.communicate()
    (tmp_path / ".crops.h5.partial-node-17-17.h5").write_text("what the killed run left")
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
    assert [p.name for p in tmp_path.iterdir()] == ["x.h5"]


@pytest.mark.parametrize(
    "left", [b"", b"\xff\x00", b'{"host": "node", "pid": 99999999999999999999999, "began": -1e999}']
)
def test_what_a_lost_run_left_is_no_obstacle(tmp_path, left):
    for path in (lock_path(tmp_path / "x.h5"), record_path(tmp_path / "x.h5")):
        path.write_bytes(left)
    with claim(tmp_path / "x.h5"):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("elsewhere")])
def test_what_is_no_lock_is_named_and_stays(tmp_path, make):
    lock = lock_path(tmp_path / "x.h5")
    make(lock)
    with pytest.raises(ConfigError, match="found no regular file; remove it"), claim(tmp_path / "x.h5"):
        pass
    assert [p.name for p in tmp_path.iterdir()] == [lock.name]


def test_a_pipe_in_the_place_of_the_record_does_not_hang(tmp_path):
    os.mkfifo(record_path(tmp_path / "x.h5"))
    with claim(tmp_path / "x.h5") as nothing:
        assert nothing is None


def test_a_file_system_without_locks_has_files_in_their_place(tmp_path, monkeypatch):
    """As Lustre mounted without ``flock``: two runs exclude each other, and a killed one is no obstacle."""

    def flock(number, how):
        raise OSError(errno.ENOSYS, "no locks")

    monkeypatch.setattr(fcntl, "flock", flock)
    other = hold(tmp_path / "x.h5", before=NO_FLOCK)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # filelock's own word on it
        with pytest.raises(ConfigError, match="another run"), claim(tmp_path / "x.h5"):
            pass
        other.send_signal(signal.SIGKILL)
        other.communicate()
        with claim(tmp_path / "x.h5"):
            pass
    assert not list(tmp_path.iterdir())


def test_parts_of_a_run_whose_driver_holds_the_lock_are_not_locked(tmp_path):
    other = hold(tmp_path / "x.h5")
    try:
        with unlocked(), atomic_path(tmp_path / "x.h5") as partial:
            partial.write_text("part")
        assert (tmp_path / "x.h5").read_text() == "part"
    finally:
        other.kill()
        other.communicate()


@pytest.mark.parametrize(
    ("mine", "other"),
    [
        ("big", "big.h5"),
        ("big.h5", "big"),
        ("x.h5", "x.partial-y.h5"),
        ("x.partial-y.h5", "x.h5"),
        ("x", "x.partial-y"),
    ],
)
def test_a_run_leaves_the_temporary_files_of_other_outputs_alone(tmp_path, mine, other):
    """`simulate -o scene` beside `ingest -o scene.h5`, both with their defaults."""
    with atomic_path(tmp_path / other) as partial, scratch_path(tmp_path / other, "grid") as scratch:
        for path in (partial, scratch):
            path.write_text("of a run that writes")
        with claim(tmp_path / mine):
            assert partial.exists() and scratch.exists()
    own = partial_path(tmp_path / mine)
    own.write_text("left behind")
    with claim(tmp_path / mine):
        assert not own.exists()


def _take(path, out, everyone_answered):
    try:
        with claim(path):
            out.put("got it")
            everyone_answered.wait(20)
    except ConfigError:
        out.put("refused")


def test_one_of_many_gets_what_a_killed_run_held(tmp_path):
    other = hold(tmp_path / "x.h5")
    other.kill()
    other.communicate()
    assert lock_path(tmp_path / "x.h5").exists()
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
from unittest import mock
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
    assert sorted(p.name for p in tmp_path.iterdir()) == [".map.h5.lock", ".map.h5.run", "map.png", "map.tif"]
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


def test_a_run_that_was_not_told_to_replaces_no_file_at_all(tmp_path):
    """Also where the stage forgot to name the file among its outputs."""
    forgotten, told, new = (tmp_path / name for name in ("forgotten.txt", "told.txt", "new.txt"))
    for path in (forgotten, told):
        path.write_text("there before")
    with protect(Inputs(), [Target(told)], overwrite=True):
        for path in (told, new, new):  # what the run itself wrote it may write again
            write_json(path, 1)
        with pytest.raises(ConfigError, match="exists already"):
            write_json(forgotten, 1)
    with protect(Inputs(), [Target(told)]), pytest.raises(ConfigError, match="exists already"):
        write_json(told, 1)
    assert forgotten.read_text() == "there before"


def test_a_folder_that_takes_no_files_is_not_taken_for_another_run(tmp_path):
    output = tmp_path / "x.h5"
    with (
        mock.patch("filelock.FileLock.acquire", side_effect=filelock.Timeout("x")),
        pytest.raises(ConfigError, match="no file can be made in this folder"),
        claim(output),
    ):
        pass
