"""The scripts in `examples/` run as they are, and say what their docstrings promise."""

from __future__ import annotations

import runpy

import pytest
from conftest import ROOT


@pytest.mark.parametrize(
    ("script", "says"),
    [("new_effect", "haze 0.002"), ("new_camera", "round trip"), ("new_matcher", "moved by 2.0, 0.0 px")],
)
def test_example_runs(script, says, capsys):
    runpy.run_path(str(ROOT / "examples" / f"{script}.py"), run_name="__main__")
    assert says in capsys.readouterr().out
