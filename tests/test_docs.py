"""The pages say what is: the list of commands follows the program, and what is printed as code runs."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest
from conftest import ROOT

PYTHON = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.S)
TUTORIAL = re.findall(r"```bash\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(), re.S)


def test_the_list_of_commands_is_up_to_date():
    """If this fails after a change to an option: python examples/cli_page.py"""
    page = runpy.run_path(str(ROOT / "examples" / "cli_page.py"))["page"]()
    assert (ROOT / "docs" / "cli.md").read_text() == page


@pytest.mark.parametrize("code", PYTHON)
def test_python_examples_run(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "docs/python.md", "exec"), {})


@pytest.fixture
def notebook():
    return SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "notebook_page.py")))


def test_the_notebook_goes_from_pairs_to_a_relit_map(notebook, small_artefacts, tmp_path, monkeypatch):
    """As it stands, on a smaller scene: its map is what the command renders."""
    for name in ("scene", "pairs"):
        shutil.copy(small_artefacts[name], tmp_path / f"{name}.h5")
    monkeypatch.chdir(tmp_path)
    cells = notebook.read_cells(notebook.SCRIPT)
    names = notebook.run(cells)
    assert names["ratio"] == pytest.approx(1, abs=0.01) and names["correlation"] > 0.99
    assert [len(cell.pictures) for cell in cells if cell.pictures] == [1, 1, 1]
    text, pictures = notebook.page(cells)
    assert all(f"images/{name}" in text for name in pictures)
    written = json.loads(notebook.notebook(cells))
    assert written["nbformat"] == 4 and [c["cell_type"] for c in written["cells"]] == [c.kind for c in cells]


def test_the_notebooks_page_holds_the_script_as_it_is(notebook):
    """If this fails after a change to examples/relight.py: make figures"""
    cells = notebook.read_cells(notebook.SCRIPT)
    page = (ROOT / "docs" / "relight.md").read_text()
    written = json.loads((ROOT / "docs" / "relight.ipynb").read_text())
    assert re.findall(r"```python\n(.*?)\n```", page, re.S) == [c.text for c in cells if c.kind == "code"]
    assert [c["source"] for c in written["cells"]] == [c.text for c in cells]


@pytest.mark.slow
def test_the_tutorial_runs_as_printed(tmp_path):
    lines = [line for block in TUTORIAL for line in block.splitlines() if line.startswith("lunargr ")]
    assert len(lines) >= 9
    for line in lines:
        command = [sys.executable, "-m", "lunargr_cli.main", *shlex.split(line)[1:]]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
