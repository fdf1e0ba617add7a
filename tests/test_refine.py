"""refine: relief that photographs show and the DEM lacks comes into the map; albedo does not become relief, nor noise."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from albedo_scene import SUNS, plant, texture
from evaluation_scene import run_command
from refine_scene import axes, missing_waves, photographs

from schemas import ArtefactError, ConfigError
from schemas.files.outputs import Output
from stages import albedo, merge, refine
from stages.physics.maps.window import Window

QUIET = refine.Config(geotiff=False)
INNER = np.s_[12:-12, 12:-12]


def read(path, *names):
    with h5py.File(path) as file:
        return [file[name][...] for name in names]


def rms(values) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def made(planted, name="refined.h5", **options):
    """(summary, path) of a planted scene; options : of albedo"""
    before, after = planted.folder / f"albedo_{name}", planted.folder / name
    albedo.run(
        planted.map, planted.scene, None, Output(before, overwrite=True), albedo.Config(geotiff=False, **options)
    )
    return refine.run(before, planted.scene, None, Output(after, overwrite=True), QUIET), after


@pytest.fixture(scope="module")
def waves():
    return missing_waves(np.random.default_rng(11))


@pytest.fixture(scope="module")
def planted(tmp_path_factory, waves):
    """Six photographs of textured ground with relief that the DEM lacks."""
    rng = np.random.default_rng(5)
    truth = np.exp(texture(rng))
    return plant(tmp_path_factory.mktemp("planted"), truth, photographs(rng, truth, waves))


@pytest.fixture(scope="module")
def found(planted):
    return made(planted)


def test_relief_that_the_dem_lacks_comes_back_within_its_error_bars(found, waves):
    summary, path = found
    assert summary.reason == "" and summary.gain[1] > 0
    correction, std = read(path, "elevation_correction", "elevation_std")
    truth = waves.heights(*axes())
    assert rms((truth - correction)[INNER]) < 0.4 * rms(truth[INNER])
    z = ((truth - correction) / std)[INNER]
    assert np.mean(np.abs(z) < 1.96) > 0.92
    assert rms(z) > 0.5  # wide intervals would hold as well


def test_the_albedo_is_closer_to_the_truth_than_without_heights(found, planted):
    with_heights, alone, std = read(found[1], "albedo", "albedo_alone", "albedo_std")

    def error(factor):
        log = np.log(factor / planted.albedo)[INNER]
        return log - log.mean()

    assert rms(error(with_heights)) < 0.5 * rms(error(alone))
    z = error(with_heights) / (std / with_heights)[INNER]
    assert np.mean(np.abs(z) < 1.96) > 0.90


def test_the_elevation_is_the_dem_plus_the_correction(found, planted):
    elevation, correction = read(found[1], "elevation", "elevation_correction")
    (dem,) = read(planted.map, "elevation")
    np.testing.assert_allclose(elevation, dem + correction, atol=1e-3)


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """The same where the DEM lacks nothing: all that the map lacks is albedo."""
    rng = np.random.default_rng(5)
    truth = np.exp(texture(rng))
    return plant(tmp_path_factory.mktemp("complete"), truth, photographs(rng, truth, missing_waves(rng, slope=0.0)))


@pytest.mark.slow
def test_a_dem_that_lacks_nothing_stays_within_its_error_bars_and_albedo_does_not_become_relief(complete, monkeypatch):
    from stages.refine import stage
    from stages.refine.judge import find_out

    decided = []

    def force(*arguments):  # whatever is decided: what the images would make of it
        decided.append(find_out(*arguments))
        return replace(decided[0], reason="")

    monkeypatch.setattr(stage, "find_out", force)
    _, path = made(complete)
    correction, std = read(path, "elevation_correction", "elevation_std")
    assert decided[0].reason  # the DEM would have stayed
    assert np.mean(np.abs(correction / std)[INNER] < 1.96) > 0.92
    east = (correction[:, 2:] - correction[:, :-2])[INNER] / 40.0
    # shading of a Sun at 45 degrees changes by as much as the slope, relative to its brightness
    assert rms(east) < 0.1 * rms(np.log(complete.albedo)[INNER])


def test_levels_of_images_leave_no_step_where_one_ends():
    from stages.refine.patch import Predicted, Residual, _level

    def residual(k, width, level):
        one, none = np.ones((64, width), np.float32), np.zeros((64, width), np.float32)
        predicted = Predicted(one, none, none, one > 0, one, none)
        return Residual(k, Window(0, 0, 64, width), predicted, level * one, 1e-4 * one)

    seen = [residual(0, 64, 0.1), residual(1, 32, -0.1)]
    _level(seen, np.zeros((64, 64), np.float32))
    for r in seen:
        np.testing.assert_allclose(r.relative, 0, atol=1e-4)


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_three_images_leave_the_dem_as_it_was(planted, count):
    others = tuple(f"IMG{k}" for k in range(count, len(SUNS)))
    summary, path = made(planted, f"{count}.h5", leave_out=others)
    assert "no three images" in summary.reason
    correction, elevation = read(path, "elevation_correction", "elevation")
    assert not correction.any()
    np.testing.assert_array_equal(elevation, read(planted.map, "elevation")[0])


def test_bad_input_is_refused_in_one_line(planted, found, tmp_path):
    out = tmp_path / "out.h5"
    for svbrdf, words in ((planted.map, "found none"), (found[1], "refined already")):
        with pytest.raises(ArtefactError, match=words) as caught:
            refine.run(svbrdf, planted.scene, None, out, QUIET)
        assert "\n" not in str(caught.value) and not out.exists()
    with pytest.raises(ConfigError, match="draws"):
        refine.run(found[1], planted.scene, None, out, replace(QUIET, draws=1))


@pytest.mark.slow
def test_shards_and_parts_give_the_same_bytes(planted, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.physics.images.windows.BLOCK_PX", 128)
    names = ("elevation", "elevation_correction", "elevation_std", "albedo", "albedo_std", "refine_trust")
    before, whole, calibration = (tmp_path / n for n in ("albedo.h5", "whole.h5", "calibration.json"))
    albedo.run(planted.map, planted.scene, None, before, albedo.Config(geotiff=False))
    config = refine.Config(geotiff=True)
    refine.run(before, planted.scene, None, whole, config)
    refine.calibrate_to(before, planted.scene, calibration, config)
    parts = [tmp_path / f"part{k}.h5" for k in range(2)]
    for k, part in enumerate(parts):
        refine.run(before, planted.scene, calibration, part, replace(config, shard=(k, 2)))
    merge.run(parts, tmp_path / "merged.h5")
    refine.run(before, planted.scene, None, Output(tmp_path / "resumed.h5", resume=True, parts=2), config)
    for other in ("merged", "resumed"):
        for name, a, b in zip(names, read(whole, *names), read(tmp_path / f"{other}.h5", *names), strict=True):
            assert a.tobytes() == b.tobytes(), (other, name)


@pytest.mark.slow
def test_held_out_images_are_scored_with_the_refined_elevation(planted, tmp_path):
    from stages import project, sample

    crops, pairs = tmp_path / "crops.h5", tmp_path / "pairs.h5"
    sample.run(planted.scene, crops, sample.Config(count=60, tile_m=640, seed=1))
    project.run(crops, pairs, project.Config())
    _, fold = made(planted, "fold.h5", fold=(0, 2))
    out = tmp_path / "evaluation.h5"
    code, _ = run_command("held-out", pairs, fold, "-o", out)
    assert code == 0
    result = json.loads(out.with_suffix(".json").read_text())
    mse = {name: row["mse"] for name, row in result["models"].items()}
    assert mse["refined"] < 0.5 * mse["albedo"] < mse["terrain"]
    assert result["gains"]["refined"]["albedo"]["gain_percent"] > 50
    assert read(fold, "albedo_image_id")[0].astype(str).tolist() == ["IMG1", "IMG3", "IMG5"]


def test_the_geotiff_is_a_dem_for_ingest(found, tmp_path):
    from stages import ingest
    from stages.physics.maps.geotiff import write_geotiff
    from stages.physics.maps.grid import read_grid

    picture, scene = tmp_path / "refined.tif", tmp_path / "scene.h5"
    with h5py.File(found[1]) as file:
        write_geotiff(picture, file, read_grid(file, found[1]))
    ingest.run(picture, None, scene, ingest.Config(crop=64))
    np.testing.assert_array_equal(read(scene, "elevation")[0], read(found[1], "elevation")[0])


def test_the_report_shows_the_relief_before_and_after(found, tmp_path):
    page = tmp_path / "report.html"
    code, _ = run_command("report", found[1], "-o", page)
    assert code == 0
    text = page.read_text()
    gain, low, high = read(found[1], "refine_gain_percent")[0]
    assert f"{gain:.1f} % lower" in text and f"({low:.1f} to {high:.1f})" in text
    assert "Correction of the elevation, m" in text and "what the DEM lacks" in text
