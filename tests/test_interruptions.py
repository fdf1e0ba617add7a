"""Ctrl-C at odd moments, inputs that vanish and disks that fill while a stage works: one line, and nothing half-written."""

from __future__ import annotations

import subprocess
import sys

import pytest

LINE = "lunargr: interrupted; nothing half-written was kept.\n"


def python(program: str) -> subprocess.CompletedProcess:
    words = [sys.executable, "-c", f"import os, signal, sys; sys.argv = ['lunargr', 'schema', 'pairs']; {program}"]
    return subprocess.run(words, capture_output=True, text=True)


@pytest.mark.parametrize(
    "program",
    [
        "import lunargr_cli; os.kill(os.getpid(), signal.SIGINT); import lunargr_cli.main",  # while it is imported
        "from lunargr_cli import main; main.app = lambda: os.kill(os.getpid(), signal.SIGINT); main.main()",
        # a library that makes another error of it, as numpy's and numba's imports do
        "import lunargr_cli.main as m\ndef app():\n try: os.kill(os.getpid(), signal.SIGINT)\n"
        " except KeyboardInterrupt: raise ImportError('numpy')\nm.app = app\nm.main()",
    ],
)
def test_ctrl_c_is_one_line_wherever_it_falls(program):
    done = python(program)
    assert (done.returncode, done.stderr) == (130, LINE)


def test_a_library_keeps_its_handlers():
    done = python("sys.argv = ['other']; import lunargr_cli; os.kill(os.getpid(), signal.SIGINT)")
    assert "KeyboardInterrupt" in done.stderr
