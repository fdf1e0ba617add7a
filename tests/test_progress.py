"""What is left of a loop is told right: after a slow start, after a resume, and in one round after another."""

from __future__ import annotations

import io
import re
import sys

import h5py
import numpy as np
import pytest
from evaluation_scene import make_scene, write_pairs

from lunargr_cli.console import Console
from stages import train


class Clock:
    """A clock that moves when it is told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def test_a_line_that_is_said_takes_the_place_of_the_bar(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    console = Console()
    console.progress(1, 4, "epoch 1/2")
    console.say("epoch   1/2 done")
    console.progress(4, 4, "epoch 2/2")
    drawn = screen.getvalue()
    assert "━" in drawn and "\r\x1b[Kepoch   1/2 done\n" in drawn and "100%" in drawn and drawn.endswith("\n")


@pytest.mark.parametrize(("encoding", "columns"), [("ascii", 80), ("utf-8", 30), ("utf-8", 200)])
def test_the_bar_fits_its_line_and_uses_the_terminal_s_characters(monkeypatch, encoding, columns):
    screen = Terminal()
    screen.encoding = encoding
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("NO_COLOR", "1")
    Console().progress(123, 600, "pairs (M103595705) [b]")
    drawn = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|\r", "", screen.getvalue())
    assert 10 < len(drawn) < columns and "\n" not in drawn
    drawn.encode(encoding)


def test_a_log_gets_a_line_now_and_then_with_what_is_left_of_this_loop(monkeypatch):
    """Also where a resumed run begins in the middle, and where a second loop follows."""
    log, clock = io.StringIO(), Clock()
    monkeypatch.setattr(sys, "stderr", log)
    console = Console(clock=clock)
    for first, total, seconds in ((0, 100, 1.0), (100, 200, 2.0)):
        for done in range(first, total + 1):
            console.progress(done, total, "rows")
            clock.now += seconds
    lines = [line.split() for line in log.getvalue().splitlines()]
    assert lines[0] == ["rows", "10%", "0:00:10", "left", "0:01:30"]
    assert lines[9] == ["rows", "100%", "0:01:40", "left", "0:00:00"]
    assert ["rows", "75%", "0:01:40", "left", "0:01:40"] in lines


def test_training_counts_the_batches_of_all_epochs_and_what_follows_them(tmp_path):
    """Validation and standard deviations. And the file says the same number of the best epoch as the terminal."""
    scene = make_scene(np.random.default_rng(11), pairs=32, size=16, frames=2)
    scene.split = np.repeat([0, 1, 2], [16, 8, 8]).astype(np.uint8)
    pairs = write_pairs(tmp_path / "pairs.h5", scene)
    config = train.Config(model="M2", epochs=3, batch=4, widths=(2, 4), device="cpu", precision="fp32")
    said, reports = [], []
    train.run(pairs, tmp_path / "c.h5", config, say=said.append, progress=lambda *report: reports.append(report))
    counts = [done for done, _, _ in reports]
    assert counts == sorted(set(counts)) and {total for _, total, _ in reports} == {counts[-1]}
    assert {what for _, _, what in reports} == {
        "epoch 1/3",
        "epoch 2/3",
        "epoch 3/3",
        "validation",
        "standard deviations",
    }
    starred = [line for line in said if line.startswith("epoch ") and "*" in line][-1]
    with h5py.File(tmp_path / "c.h5") as file:
        assert f"epoch {file.attrs['best_epoch']:3d}/3" in starred
