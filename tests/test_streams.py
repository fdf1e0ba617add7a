"""What reaches the terminal: results on standard output, our own lines on standard error, and nothing that steers it."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import h5py
import pytest
from cluster_scene import LUNARGR, environment

from lunargr_cli.console import Console, harmless, say_error, write_out
from lunargr_cli.main import take_verbose
from stages.common import caches


def shell(line: str, cwd: Path) -> subprocess.CompletedProcess:
    """A command line as bash runs it, with `lunargr` for the command."""
    lunargr = " ".join(map(shlex.quote, LUNARGR))
    words = ["bash", "-c", f'set -o pipefail; lunargr() {{ {lunargr} "$@"; }}; {line}']
    return subprocess.run(words, cwd=cwd, capture_output=True, env=environment())


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("lunargr schema pairs >&-", 0, ""),
        ("lunargr schema pairs > /dev/full", 3, "standard output: cannot be written (No space left on device)"),
        ("lunargr models 2>&- | cat > /dev/null", 0, ""),
        ("lunargr models | true", None, ""),  # as after `| head`: silent
        ("mkdir gone && cd gone && rmdir ../gone && lunargr schema pairs", 3, "the working folder is gone"),
        ("ln -s loop.h5 loop.h5 && lunargr sample loop.h5 -o x.h5", 3, "a symbolic link that leads to itself"),
        (
            "ln -s loop.h5 loop.h5 && lunargr sample in.h5 -o loop.h5 --overwrite",
            3,
            "a symbolic link that leads to itself",
        ),
        ("lunargr models --json /dev/null --overwrite", 3, "a device, pipe or socket"),
        ("mkfifo pipe && lunargr models --json pipe --overwrite", 3, "a device, pipe or socket"),
        ("mkdir dir && lunargr models --json dir --overwrite", 3, "found a folder"),
        ("touch f && lunargr models --json f/x.json", 3, "cannot be written (Not a directory)"),
        ("touch f && lunargr models --json f", 3, "f: exists already; add --overwrite"),
        ("lunargr sample $'a\\xff.h5' -o x.h5", 3, "a\\udcff.h5: expected a name in UTF-8"),
        ("lunargr inspect $'a\\xff.h5'", 3, "a\\udcff.h5: expected a name in UTF-8"),
    ],
)
def test_odd_streams_names_and_folders_are_one_line(tmp_path, line, code, words):
    done = shell(line, tmp_path)
    said = done.stderr.decode()
    assert code is None or done.returncode == code, said
    assert len(said.splitlines()) == (1 if words else 0) and words in said


def test_a_result_goes_into_a_folder_that_is_not_there_yet(tmp_path):
    assert shell("lunargr models --json a/b/models.json", tmp_path).returncode == 0
    assert (tmp_path / "a" / "b" / "models.json").stat().st_size
    assert not list(tmp_path.rglob(".*"))


LIBRARIES = """
import logging, os, sys, warnings
import lunargr_cli.main as m
def app():
    os.write(2, b"libtiff: TIFFReadDirectory\\n")
    warnings.warn("numpy: invalid value")
    logging.getLogger("rasterio._env").warning("CPLE_AppDefined in PROJ")
    m.say_error("ours")
m.app = app
m.main()
"""


@pytest.mark.parametrize("let_through", [False, True])
def test_standard_error_holds_our_own_lines(let_through):
    known = {k: v for k, v in environment().items() if k != "PYTHONWARNINGS"}
    known |= {"LUNARGR_LIBRARY_MESSAGES": "1"} if let_through else {}
    done = subprocess.run([sys.executable, "-c", LIBRARIES], capture_output=True, text=True, env=known)
    found = done.stderr.splitlines()
    assert "lunargr: ours" in found
    assert (len(found) > 3) == let_through, found


def test_a_bug_keeps_its_traceback():
    program = "import lunargr_cli.main as m\ndef app(): raise KeyError('bug')\nm.app = app\nm.main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment())
    assert done.returncode == 1 and "Traceback" in done.stderr and "KeyError: 'bug'" in done.stderr


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred", "\\x1b[31mred"),
        ("a\x9b2J", "a\\x9b2J"),
        ("\u202eevil", "\\u202eevil"),
        ("\udcff", "\\udcff"),
        ("line\nnext\ttab é 月", "line\nnext\ttab é 月"),
    ],
)
def test_what_steers_a_terminal_is_spelled_out(capsys, text, shown):
    assert harmless(text) == shown
    Console().say(text)
    write_out(text)
    Console().table(text, (text,), [(text,)])
    say_error(text)
    found = capsys.readouterr()
    assert "\x1b" not in found.out + found.err and "\u202e" not in found.out + found.err
    assert found.err.startswith(shown) and found.out.startswith(shown)


def test_escape_codes_of_a_file_do_not_reach_the_terminal(small_artefacts, tmp_path):
    path = tmp_path / "scene.h5"
    path.write_bytes(small_artefacts["scene"].read_bytes())
    with h5py.File(path, "a") as file:
        file["image_id"][0] = "\x1b]0;owned\x07"
        file.attrs["title"] = file.attrs["command"] = "\x1b[2J"
    for line in ("lunargr inspect scene.h5", "lunargr replay scene.h5"):
        done = shell(line, tmp_path)
        assert done.returncode in (0, 3)  # shown, or refused and quoted
        assert b"\x1b" not in done.stdout + done.stderr and b"\\x1b" in done.stdout + done.stderr


def unwritable(monkeypatch, *folders: Path) -> None:
    """As for a user other than root, and on a read-only file system."""
    real = os.access
    inside = [str(f) for f in folders]
    monkeypatch.setattr(os, "access", lambda p, mode: not str(p).startswith(tuple(inside)) and real(p, mode))


def test_caches_go_to_a_folder_of_the_user_where_nothing_else_can_be_written(monkeypatch, tmp_path):
    package, home = tmp_path / "package", tmp_path / "home"
    package.mkdir(), home.mkdir()
    monkeypatch.setattr(caches.tempfile, "gettempdir", lambda: str(tmp_path))
    found = {"HOME": str(home)}
    caches.choose_caches(found, package)
    assert set(found) == {"HOME"}  # numba and matplotlib find their own
    unwritable(monkeypatch, package, home)
    caches.choose_caches(found, package)
    folder = Path(found["NUMBA_CACHE_DIR"]).parent
    assert folder.parent == tmp_path and folder.stat().st_mode & 0o777 == 0o700
    assert Path(found["MPLCONFIGDIR"]).parent == folder
    given = {"HOME": str(home), "NUMBA_CACHE_DIR": "/mine", "MPLCONFIGDIR": "/mine"}
    caches.choose_caches(given, package)
    assert given["NUMBA_CACHE_DIR"] == given["MPLCONFIGDIR"] == "/mine"


def test_compiled_code_is_not_loaded_from_somebody_else_s_folder(monkeypatch, tmp_path):
    package, home = tmp_path / "package", tmp_path / "home"
    package.mkdir(), home.mkdir()
    open_to_all = tmp_path / f"lunargr-{os.getuid()}"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    monkeypatch.setattr(caches.tempfile, "gettempdir", lambda: str(tmp_path))
    unwritable(monkeypatch, package, home)
    found = {"HOME": str(home)}
    caches.choose_caches(found, package)
    assert not found["NUMBA_CACHE_DIR"].startswith(str(open_to_all) + os.sep)


@pytest.mark.slow
def test_a_quiet_command_that_succeeds_says_nothing_on_standard_error(tmp_path):
    """Every stage in turn: PROJ, libtiff, OpenImageIO, numpy and torch have each had lines of their own."""
    sun = "--sun-azimuth 100 --sun-elevation 35"
    for line in (
        "simulate -o s --size-px 256 --images 4",
        "ingest s/dem.tif --images s/images.csv --gsd 5 --crop 32",
        "sample scene.h5 --count 40 --tile-m 320",
        "project crops.h5 --register",
        "train pairs.h5 --epochs 1 --widths 4-4-8 --precision fp32",
        "infer s/dem.tif checkpoint.h5",
        f"render svbrdf.h5 {sun} -o r.exr",
        f"render --dem s/dem.tif --model hapke {sun} -o h.exr",
        "evaluate pairs.h5 checkpoint.h5 --figures f --split train",
        "match pairs.h5 checkpoint.h5 --split train --count 2 --figures f",
        "report scene.h5 svbrdf.h5 r.png",
        "merge svbrdf.h5 -o whole.h5",
    ):
        done = shell(f"lunargr {line} --quiet", tmp_path)
        assert (done.returncode, done.stderr) == (0, b""), (line, done.stderr)


@pytest.mark.parametrize("line", ["lunargr -v schema pairs", "lunargr schema pairs --verbose"])
def test_verbose_tells_time_and_memory_wherever_it_stands(tmp_path, line):
    done = shell(line, tmp_path)
    assert done.returncode == 0 and b"elevation" in done.stdout
    assert re.fullmatch(rb"lunargr: [\d.]+ s, [\d.]+ s of processor time, at most \d+ MB\n", done.stderr)


def test_verbose_is_no_part_of_the_command_line():
    words = ["train", "p.h5", "-v", "--", "-v"]
    assert take_verbose(words) and words == ["train", "p.h5", "--", "-v"]
    assert not take_verbose(words)
