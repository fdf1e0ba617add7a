"""The pages follow the program: the list of commands is current, printed commands and options exist, and examples run."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from rasterio.transform import Affine

from stages import simulate
from stages.physics.bodies.spheres import RADII, find_body
from stages.physics.maps.grid import Grid, local_metric_crs
from stages.physics.terrain.sun import find_sun

PYTHON = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.S)
TUTORIAL = re.findall(r"```bash\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(), re.S)


def test_the_list_of_commands_is_up_to_date():
    """If this fails after a change to an option: python examples/cli_page.py"""
    page = runpy.run_path(str(ROOT / "examples" / "cli_page.py"))["page"]()
    assert (ROOT / "docs" / "cli.md").read_text() == page


@pytest.mark.parametrize("code", PYTHON)
def test_python_examples_run(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # they write files
    exec(compile(code, "docs/python.md", "exec"), {})


def printed_commands():
    """(page, words) of every command that README and docs print, those with gaps for the reader to fill left out."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text().replace("\\\n", " ")
        fenced = "\n".join(re.findall(r"^```(?:bash|sh)?\n(.*?)^```", text, re.M | re.S))
        for line in re.findall(r"^ {4}(lunargr .*)$", text, re.M) + re.findall(r"^(lunargr .*)$", fenced, re.M):
            for command in re.split(r";|>|\s#|\s{3,}", line):
                words = shlex.split(command)
                if words[:1] == ["lunargr"] and not re.search(r"\.\.\.|[|<]|\b[A-Z]{4,}\b|\[", command):
                    yield page.name, words[1:]


def test_the_commands_that_the_pages_print_have_such_options():
    known = known_commands()
    found = list(printed_commands())
    assert len(found) > 60
    for page, (name, *options) in found:
        try:
            known[name].make_context(name, list(options))
        except Exception as error:  # typer has its own copy of click's
            pytest.fail(f"{page}: lunargr {shlex.join([name, *options])}: {error}")


def known_commands():
    from typer.main import get_command

    from lunargr_cli.main import app

    return get_command(app).commands


def mentioned_options(commands):
    """(page, option) of every `--option` in the prose and tables of README and docs."""
    begins = re.compile(rf"--\w|lunargr |({'|'.join(commands)}) --")
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for code in filter(begins.match, re.findall(r"`([^`\n]+)`", page.read_text())):
            for option in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", code):
                yield page.name, option


def test_every_option_that_the_pages_mention_exists():
    commands = known_commands()
    exist = {o for command in commands.values() for p in command.params for o in [*p.opts, *p.secondary_opts]}
    exist |= {"--version", "--verbose", "--install-completion", "--show-completion", "--help"}
    found = list(mentioned_options(commands))
    assert len(found) > 100
    assert [(page, option) for page, option in found if option not in exist] == []


WORDS = {
    "README.md": 900,
    "CHANGELOG.md": 800,
    "docs/diagnose.md": 900,
    "docs/diagnose_method.md": 1200,
    "docs/diagnose_campaigns.md": 400,
}


@pytest.mark.parametrize("page", WORDS)
def test_pages_stay_short(page):
    assert len((ROOT / page).read_text().split()) <= WORDS[page]


def test_the_documentation_stays_short():
    assert sum(len(page.read_text().split()) for page in (ROOT / "docs").glob("*.md")) <= 18_000


def test_the_example_time_has_the_sun_up_over_the_embedded_scene():
    [time] = set(re.findall(r"--time (\S+)", (ROOT / "docs" / "render.md").read_text()))
    config = simulate.make_config({})
    grid = Grid(local_metric_crs(config.longitude_deg, config.latitude_deg, RADII["moon"]).to_wkt(),
                Affine(5, 0, -100, 0, -5, 100), 40, 40, RADII["moon"])  # fmt: skip
    sun = find_sun(grid, find_body("moon"), time=time)
    up = grid.local_frames(20, 20).axes[0, 2]
    assert np.degrees(np.arcsin(up @ sun.position / np.linalg.norm(sun.position))) > 15


@pytest.fixture
def notebook():
    return SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "notebook_page.py")))


@pytest.mark.slow
def test_the_notebook_goes_from_pairs_to_a_relit_map(notebook, small_artefacts, tmp_path, monkeypatch):
    """As it stands, on a smaller scene: its map is what the command renders."""
    for name in ("scene", "pairs"):
        shutil.copy(small_artefacts[name], tmp_path / f"{name}.h5")
    monkeypatch.chdir(tmp_path)
    cells = notebook.read_cells(notebook.SCRIPT)
    names = notebook.run(cells)
    assert names["ratio"] == pytest.approx(1, abs=0.01) and names["correlation"] > 0.99
    assert [len(cell.pictures) for cell in cells if cell.pictures] == [1, 1, 1]
    written = json.loads(notebook.notebook(cells))
    assert written["nbformat"] == 4 and [c["cell_type"] for c in written["cells"]] == [c.kind for c in cells]


def test_the_notebook_holds_the_script_as_it_is(notebook):
    """If this fails after a change to examples/relight.py: make figures"""
    cells = notebook.read_cells(notebook.SCRIPT)
    written = json.loads((ROOT / "docs" / "relight.ipynb").read_text())
    assert [c["source"] for c in written["cells"]] == [c.text for c in cells]


@pytest.mark.slow
def test_the_tutorial_runs_as_printed(tmp_path):
    lines = [line for block in TUTORIAL for line in block.splitlines() if line.startswith("lunargr ")]
    assert len(lines) >= 9
    for line in lines:
        command = [sys.executable, "-m", "lunargr_cli.main", *shlex.split(line)[1:]]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
