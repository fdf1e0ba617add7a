"""The pages say what is: the list of commands follows the program, and what is printed as code runs."""

from __future__ import annotations

import re
import runpy
import shlex
import subprocess
import sys

import pytest
from conftest import ROOT

PYTHON = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.S)
TUTORIAL = re.findall(r"```bash\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(), re.S)


def test_the_list_of_commands_is_up_to_date():
    """If this fails after a change to an option: python examples/cli_page.py"""
    page = runpy.run_path(str(ROOT / "examples" / "cli_page.py"))["page"]()
    assert (ROOT / "docs" / "cli.md").read_text() == page


@pytest.mark.parametrize("code", PYTHON)
def test_python_examples_run(code):
    exec(compile(code, "docs/python.md", "exec"), {})


@pytest.mark.slow
def test_the_tutorial_runs_as_printed(tmp_path):
    lines = [line for block in TUTORIAL for line in block.splitlines() if line.startswith("lunargr ")]
    assert len(lines) >= 9
    for line in lines:
        command = [sys.executable, "-m", "lunargr_cli.main", *shlex.split(line)[1:]]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
