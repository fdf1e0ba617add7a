"""Which model differences exceed their noise: false alarms, power, and the command."""

from __future__ import annotations

import json

import numpy as np
import pytest
from evaluation_scene import make_scene, run_command, write_pairs

from schemas import ConfigError
from stages.compare import Trained, compare

TILES, CROPS, PIXELS = 30, 4, 1000.0


def _runs(rng, means, seed_std=0.05, seeds=3):
    """Runs whose crops share a difficulty per tile; the training noise multiplies all crops of a run."""
    tile = np.repeat(np.arange(TILES), CROPS)
    difficulty = rng.gamma(8, 1 / 8, TILES)[tile]
    runs = []
    for model, mean in means.items():
        taste = 1 + 0.05 * rng.normal(size=TILES)[tile]
        for seed in range(seeds):
            mse = mean * difficulty * taste * (1 + seed_std * rng.normal())
            runs.append(Trained(model, seed, mse * PIXELS, np.full(len(tile), PIXELS), tile, 0, np.ones(3)))
    return runs


def test_the_table_is_the_mean_over_seeds_and_sorted(rng):
    runs = _runs(rng, {"M1": 2.0, "M2": 1.0})
    result = compare(runs)
    assert list(result["models"]) == ["M2", "M1"]
    for name, row in result["models"].items():
        mine = [r.squared_error.sum() / r.pixels.sum() for r in runs if r.model == name]
        assert row["mse"] == pytest.approx(np.mean(mine)) and row["mse_seed_std"] == pytest.approx(np.std(mine, ddof=1))
        assert row["mse_crop_sum"] == pytest.approx(row["mse"] * PIXELS)
        assert row["mse_low"] < row["mse"] < row["mse_high"]
    assert result["models"]["M2"]["paper_mse_crop_sum"] == 4.06


def test_equal_models_are_rarely_told_apart(rng):
    alarms = [
        any(p["larger_than_noise"] for p in compare(_runs(rng, dict.fromkeys(["a", "b", "c"], 1.0)))["differences"])
        for _ in range(60)
    ]
    assert np.mean(alarms) <= 0.1


def test_a_large_difference_is_found_and_a_small_one_is_not_claimed(rng):
    found = [compare(_runs(rng, {"a": 1.0, "b": 1.02, "c": 1.6}, seed_std=0.03))["differences"] for _ in range(20)]
    verdicts = {frozenset((p["better"], p["worse"])): [] for p in found[0]}
    for pairs in found:
        for p in pairs:
            verdicts[frozenset((p["better"], p["worse"]))].append(p["larger_than_noise"])
    assert np.mean(verdicts[frozenset("ac")]) > 0.9
    assert np.mean(verdicts[frozenset("ab")]) < 0.2


def test_one_seed_gives_no_verdict(rng):
    result = compare(_runs(rng, {"a": 1.0, "b": 2.0}, seeds=1))
    assert result["differences"][0]["larger_than_noise"] is None
    with pytest.raises(ConfigError, match="two models"):
        compare(_runs(rng, {"a": 1.0}))


def test_the_command_trains_compares_and_resumes(tmp_path):
    scene = make_scene(np.random.default_rng(2), pairs=24)
    scene.split[::4] = 1
    write_pairs(tmp_path / "pairs.h5", scene)
    few = "--models M1,m2 --seeds 2 --epochs 1 --batch 8 --widths 4-8 --device cpu"
    options = (*few.split(), "-o", tmp_path / "out")
    code, printed = run_command("compare", tmp_path / "pairs.h5", *options)
    assert code == 0 and "larger than its noise" in printed
    result = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert set(result["models"]) == {"M1", "M2"} and result["models"]["M1"]["seeds"] == [0, 1]
    assert (tmp_path / "out" / "validation_curves.png").stat().st_size > 5000
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "out").glob("*.h5")}
    assert run_command("compare", tmp_path / "pairs.h5", *options)[0] == 3
    assert run_command("compare", tmp_path / "pairs.h5", *options, "--resume", "-q")[0] == 0
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "out").glob("*.h5")} == before


@pytest.mark.parametrize("options", [["--models", "M2"], ["--models", "M1,M9"], ["--split", "nothing"]])
def test_bad_options_are_one_line(tmp_path, options):
    code, message = run_command("compare", tmp_path / "pairs.h5", "-o", tmp_path / "out", *options)
    assert code == 3 and "\n" not in message and not (tmp_path / "out").exists()
