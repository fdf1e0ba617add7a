"""What is left of a loop is told right: after a slow start, after a resume, and in one round after another."""

from __future__ import annotations

import io
import sys

import h5py
import numpy as np
import pytest
from evaluation_scene import make_scene, write_pairs

import lunargr_cli.console
from lunargr_cli.console import Console
from lunargr_cli.progress import Pace, bar_line, duration
from stages import train


class Clock:
    """A clock that moves when it is told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def epochs(count, steps, seconds, first=0, validation=4):
    """(done, total, seconds that it took) of a training, as train counts its work; its first steps compile and read."""
    length = 3 * steps + validation
    for epoch in range(first, count):
        for step in range(steps):
            yield epoch * length + 3 * (step + 1), count * length, seconds * (10 if epoch == first and step < 4 else 1)
        for step in range(validation):
            yield epoch * length + 3 * steps + step + 1, count * length, 0.4 * seconds


@pytest.mark.parametrize("first", [0, 3])
def test_what_is_left_of_a_training_is_right_from_its_second_epoch_on(first):
    clock = Clock()
    pace = Pace(clock)
    clock.now += 500  # reading, compiling: before the loop
    reports = list(epochs(8, steps=20, seconds=2.0, first=first))
    for number, (done, total, seconds) in enumerate(reports):
        clock.now += seconds
        elapsed, left = pace.report(done, total)
        truth = sum(r[2] for r in reports[number + 1 :])
        assert elapsed <= sum(r[2] for r in reports[: number + 1])
        if done >= (first + 1) * 64:
            assert left == pytest.approx(truth, rel=0.1, abs=1.0), done
    assert left == 0


def test_a_round_that_begins_again_or_has_another_total_starts_its_clock_again():
    clock = Clock()
    pace = Pace(clock)
    for total, seconds in ((10, 100.0), (10, 1.0), (30, 2.0)):
        for done in range(1, total + 1):
            clock.now += seconds
            elapsed, left = pace.report(done, total)
            assert elapsed == (done - 1) * seconds
            assert left is None if done == 1 else left == pytest.approx((total - done) * seconds)


def test_repeated_reports_and_long_loops_change_nothing():
    clock = Clock()
    pace = Pace(clock)
    for done in range(1, 20_001):
        clock.now += 0.5
        pace.report(done, 30_000)
        _, left = pace.report(done, 30_000)
    assert left == pytest.approx(5_000, rel=0.01)
    assert len(pace._times) < 1000


def test_the_bar_fits_its_line():
    for width in (20, 40, 80, 200):
        line = bar_line("pairs (M103595705)", 123, 600, (14.0, 42.0), width, plain=False)
        assert len(line) < width
    assert line == "pairs (M103595705) " + "━" * 6 + "─" * 24 + " 20 %, 14 s, 42 s left"
    assert bar_line("rows", 10, 10, (3.0, 0.0), 80, plain=True) == "rows " + "#" * 30 + " 100 %, 3 s"
    assert [duration(s) for s in (4.4, 65, 7265)] == ["4 s", "1 min 05 s", "2 h 01 min"]


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
    assert "━" in drawn and "\r\x1b[K" + "epoch   1/2 done\n" in drawn and drawn.endswith("100 %, 0 s\n")


def test_a_log_gets_a_line_now_and_then(monkeypatch):
    log, clock = io.StringIO(), Clock()
    monkeypatch.setattr(sys, "stderr", log)
    monkeypatch.setattr(lunargr_cli.console.time, "monotonic", clock)
    console = Console(_pace=Pace(clock))
    for done in range(101):
        console.progress(done, 100, "rows")
        clock.now += 1.0
    lines = log.getvalue().splitlines()
    assert (
        len(lines) == 10 and lines[0] == "rows: 10 %, 10 s, 1 min 30 s left" and lines[-1] == "rows: 100 %, 1 min 40 s"
    )


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
