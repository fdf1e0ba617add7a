"""Each planted effect does to the files what its name says, measured against the same scene without it."""

from __future__ import annotations

import csv
import json
import math

import h5py
import numpy as np
import pytest
from test_simulate_scene import SMALL, directions, offset_between, read_image

from schemas import ConfigError, RegistryError
from stages.simulate import make_config, run
from stages.simulate.hidden import CHOICES, hidden_from_option, parse_hidden

FEW = SMALL | {"images": 2, "size_px": 224, "oblique_share": 0.0, "incidence_deg": [40.0, 70.0], "read_noise": 20.0}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    run(folder, make_config(FEW))
    return folder


def planted(folder, text):
    run(folder, make_config(FEW | {"hidden": hidden_from_option(text)}))
    return folder


def rows(folder):
    with open(folder / "images.csv") as stream:
        return list(csv.DictReader(stream))


def pair(plain, other, number=0):
    name = rows(plain)[number]["path"]
    a, b = read_image(plain / name)[0], read_image(other / name)[0]
    assert np.array_equal(np.isfinite(a), np.isfinite(b))
    return a, b


def test_dark_bias_adds_the_same_everywhere(plain, tmp_path):
    a, b = pair(plain, planted(tmp_path, "dark_bias:iof=0.004"))
    difference = (b - a)[np.isfinite(a)]
    assert difference.mean() == pytest.approx(0.004, abs=2e-5) and difference.std() < 3e-4
    with h5py.File(tmp_path / "truth.h5") as truth:
        hidden = json.loads(truth.attrs["hidden"])
    assert hidden == [{"effect": "dark_bias", "parameters": {"iof": {"value": 0.004, "unit": "1"}}}]


def test_nonlinearity_bends_the_response(plain, tmp_path):
    a, b = pair(plain, planted(tmp_path, "nonlinearity:quadratic=-0.8"))
    good = np.isfinite(a)
    quadratic = np.polyfit(a[good], b[good], 2)
    assert quadratic[0] == pytest.approx(-0.8, abs=0.1) and quadratic[1] == pytest.approx(1.0, abs=0.02)


def test_saturation_is_a_ceiling(plain, tmp_path):
    a, b = pair(plain, planted(tmp_path, "saturation:iof=0.05"))
    assert np.nanmax(a) > 0.08
    assert np.nanmax(b) < 0.055


def test_blur_lowers_fine_contrast_only(plain, tmp_path):
    a, b = pair(plain, planted(tmp_path, "psf_blur:sigma2_px2=2.0"))
    good = np.isfinite(a)

    def fine(v):
        return np.nanstd(np.diff(v, axis=1))

    assert fine(b) < 0.75 * fine(a)
    assert np.mean(b[good]) == pytest.approx(np.mean(a[good]), rel=2e-3)


def test_misregistration_moves_the_content_by_what_truth_says(plain, tmp_path):
    planted(tmp_path, "misregistration:rms_px=3")
    with h5py.File(tmp_path / "truth.h5") as truth:
        for k, row in enumerate(rows(plain)):
            a, b = pair(plain, tmp_path, k)
            right, down = offset_between(a, b)
            gsd = truth["image_gsd"][k]
            # the ground that truly lies to the east appears here: content moves west
            assert right * gsd == pytest.approx(-truth["shift_east"][k], abs=0.12 * gsd)
            assert down * gsd == pytest.approx(truth["shift_north"][k], abs=0.12 * gsd)
            assert row["image_id"]


@pytest.mark.parametrize(("effect", "axis"), [("sun_azimuth", 0), ("sun_elevation", 1)])
def test_the_table_is_told_another_sun(plain, tmp_path, effect, axis):
    other = planted(tmp_path, f"{effect}:error_deg=1.5")
    config = make_config(FEW)
    for true, given in zip(rows(plain), rows(other), strict=True):
        angles = []
        assert true["start_time"] and not given["start_time"]  # a time would tell where the Sun was
        for row in (true, given):
            sun, _ = directions(config, row)
            angles.append((math.degrees(math.atan2(sun[0], sun[1])), math.degrees(math.asin(sun[2]))))
        error = np.array(angles[0]) - np.array(angles[1])
        assert error[axis] == pytest.approx(1.5, abs=0.01) and abs(error[1 - axis]) < 0.01
    a, b = pair(plain, other)
    assert np.array_equal(a, b, equal_nan=True)


def test_dem_scale_is_true_over_given(plain, tmp_path):
    other = planted(tmp_path, "dem_scale:relative=0.1")
    a, b = read_image(plain / "dem.tif")[0], read_image(other / "dem.tif")[0]
    good = np.isfinite(a)
    assert np.polyfit(b[good], a[good], 1)[0] == pytest.approx(1.1, abs=1e-3)


def test_echo_repeats_the_line(plain, tmp_path):
    a, b = pair(plain, planted(tmp_path, "echo:fraction=0.2,lag_px=4"))
    extra = b - a
    best = {}
    for lag in range(-7, 8):
        moved = np.roll(a, lag, axis=1)
        good = np.isfinite(extra) & np.isfinite(moved)
        best[lag] = np.corrcoef(extra[good], moved[good])[0, 1]
    lag = max(best, key=best.get)
    assert abs(abs(lag) - 4) <= 1 and best[lag] > 0.8
    assert np.nanmean(extra) == pytest.approx(0.2 * np.nanmean(a), rel=0.05)


def test_surge_follows_the_phase_angle(plain, tmp_path):
    other = planted(tmp_path, "opposition_surge:B0=1.0,h=0.1")
    with h5py.File(plain / "truth.h5") as truth:
        for k in range(2):
            a, b = pair(plain, other, k)
            g = math.radians(truth["phase_deg"][k])
            expected = 1 + 1.0 / (1 + math.tan(g / 2) / 0.1)
            assert np.nanmean(b) / np.nanmean(a) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    "effect", ["penumbra", "earthshine", "column_pattern", "image_gain", "line_jitter", "phase_slope"]
)
def test_every_other_effect_changes_the_images(plain, tmp_path, effect):
    a, b = pair(plain, planted(tmp_path, effect))
    assert np.nanmax(np.abs(b - a)) > 5e-4


def test_options_are_parsed_and_refused():
    assert hidden_from_option("none") == []
    assert hidden_from_option("echo:fraction=0.1,lag_px=2+dark_bias") == [
        {"effect": "echo", "fraction": "0.1", "lag_px": "2"},
        {"effect": "dark_bias"},
    ]
    with pytest.raises(RegistryError, match="dark_bias"):
        hidden_from_option("dark_biass")
    with pytest.raises(ConfigError, match="NAME=VALUE"):
        hidden_from_option("echo:0.1")
    with pytest.raises(ConfigError, match="twice"):
        hidden_from_option("echo+echo")
    for effect in CHOICES:
        assert list(parse_hidden([{"effect": effect}])) == [effect]
