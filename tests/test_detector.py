"""The detector model against closed forms: photon transfer, saturation, steps of the converter, light that no optics lose."""

from __future__ import annotations

import dataclasses
import json
import math

import cv2
import numpy as np
import pytest
from command import lunargr
from render_scene import LAT, LON, lunargr_render

from schemas.errors import ConfigError, InputError, RegistryError
from stages import render
from stages.physics.detector import Sensor, preset_names, read_sensor
from stages.physics.detector.readout import blur, photograph
from stages.render.files import DN

BASE = Sensor(full_well=40000.0, gain=2.0, bits=16, offset_dn=100.0, read_noise=12.0, auto_level=0.5)


def flat(sensor, seed, level=1.0, size=256):
    """A frame whose brightest hundredth sets the exposure, with an even field at ``level`` of it."""
    image = np.full((size, size), level, np.float32)
    image[: size // 32] = 1.0
    return photograph(sensor, image, 1.0, np.random.default_rng(seed))[size // 16 :].astype(float)


@pytest.mark.parametrize("level", [0.002, 0.03, 0.3, 1.0])
def test_the_photon_transfer_curve_is_the_sensors_own(level):
    """Half the variance of the difference of two frames: shot and read noise in DN, and the converter's step (EMVA 1288)."""
    first, second = flat(BASE, 1, level), flat(BASE, 2, level)
    electrons = level * 0.5 * BASE.full_scale
    assert first.mean() == pytest.approx(electrons / BASE.gain + BASE.offset_dn, rel=2e-3)
    expected = (electrons + BASE.read_noise**2) / BASE.gain**2 + 1 / 12
    assert np.var(first - second) / 2 == pytest.approx(expected, rel=0.02)


def test_response_differs_from_pixel_to_pixel_by_the_prnu_and_stays_from_frame_to_frame():
    sensor = dataclasses.replace(BASE, prnu=0.02, read_noise=0.0, full_well=60000.0)
    frames = [flat(sensor, seed) - sensor.offset_dn for seed in range(8)]
    electrons = 0.5 * sensor.full_scale
    between = np.mean(frames, axis=0)
    assert between.std() / between.mean() == pytest.approx(math.hypot(0.02, 1 / math.sqrt(8 * electrons)), rel=0.02)
    other = flat(dataclasses.replace(sensor, seed=7), 99) - sensor.offset_dn
    assert abs(np.corrcoef(other.ravel(), frames[0].ravel())[0, 1]) < 0.03


def test_nothing_is_brighter_than_the_full_well_or_the_last_step():
    well = dataclasses.replace(BASE, auto_level=3.0, read_noise=0.0)
    assert np.unique(flat(well, 0)).tolist() == [BASE.full_well / BASE.gain + BASE.offset_dn]
    converter = dataclasses.replace(well, bits=10)
    assert np.unique(flat(converter, 0)).tolist() == [1023.0]


def test_bits_are_steps_of_the_gain():
    sensor = dataclasses.replace(BASE, gain=500.0, read_noise=0.0, bits=8, offset_dn=10.0, auto_level=0.9)
    ramp = np.repeat(np.linspace(0, 1, 400, dtype=np.float32)[None], 64, axis=0)
    seen = photograph(sensor, ramp, 1.0, np.random.default_rng(0)).astype(float)
    exposure = sensor.expose(float(np.percentile(ramp[ramp > 0], 99.5)))
    expected = np.minimum(exposure.electrons * ramp, sensor.full_well) / 500.0 + 10.0
    photons = np.sqrt(exposure.electrons * ramp) / 500.0
    assert np.abs(seen - expected).max() <= 0.5 + 5 * photons.max()
    assert np.mean(seen - expected) == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("sigma", [0.4, 1.0, 5.0])
def test_optics_lose_no_light(sigma):
    spot = np.zeros((64, 48), np.float32)
    spot[0, 0] = spot[30, 20] = spot[40, -1] = 1.0
    seen = blur(dataclasses.replace(BASE, psf_sigma_px=sigma), spot)
    assert seen.sum(dtype=np.float64) == pytest.approx(3.0, rel=1e-5)


def test_a_defocused_spot_has_the_variance_of_its_gaussian():
    spot = np.zeros((65, 65), np.float32)
    spot[32, 32] = 1.0
    seen = blur(dataclasses.replace(BASE, psf_sigma_px=3.0), spot)
    assert (seen.sum(0) * (np.arange(65) - 32) ** 2).sum() == pytest.approx(9.0, rel=0.02)


def test_corners_lose_the_vignettings_share_and_the_middle_nothing():
    sensor = dataclasses.replace(BASE, vignetting=0.4, read_noise=0.0, gain=0.5)
    seen = photograph(sensor, np.ones((129, 129), np.float32), 1.0, np.random.default_rng(0)) - sensor.offset_dn
    expected = 0.5 * sensor.full_scale / sensor.gain
    assert seen[62:67, 62:67].mean() == pytest.approx(expected, rel=0.01)
    assert seen[[0, 0, -1, -1], [0, -1, 0, -1]].mean() == pytest.approx(0.6 * expected, rel=0.01)


def test_electrons_in_a_second_follow_from_the_sun_and_the_optics():
    """Sunlight at 1 au, W/m2 nm: 1.87 at 550 nm (ASTM E-490); so many photons pass f/4 to a 10 um pixel."""
    sensor = dataclasses.replace(
        BASE, auto_level=None, exposure_s=0.01, f_number=4.0, pixel_um=10.0, wavelength_nm=550.0, bandwidth_nm=100.0,
        quantum_efficiency=0.5, transmission=0.8,
    )  # fmt: skip
    photon = 6.62607e-34 * 2.99792e8 / 550e-9
    rate = 1.87 * 100 / photon / math.pi * math.pi / (4 * 4.0**2) * 1e-10 * 0.5 * 0.8
    assert sensor.rate(1.0) == pytest.approx(rate, rel=0.08)
    assert sensor.rate(2.0) == pytest.approx(sensor.rate(1.0) / 4)
    assert sensor.expose(0.3).electrons == pytest.approx(0.01 * sensor.rate(1.0))


def test_presets_are_whole_and_say_where_they_come_from():
    assert len(preset_names()) >= 2
    for name in preset_names():
        assert "(" in read_sensor(name).source, name


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"full_well": 1e4, "read_nose": 3}, InputError, "unknown key 'read_nose', did you mean 'read_noise'"),
        ({"read_noise": 3}, InputError, "'full_well'"),
        ({"full_well": -1}, InputError, "'full_well': expected a number in 1..1e+09, found -1"),
        ({"full_well": True}, InputError, "found True"),
        ({"full_well": 1e4, "bits": 12.5}, InputError, "'bits': expected a whole number"),
        ({"full_well": 1e4, "exposure_s": 0.1}, ConfigError, "'exposure_s': expected with f_number, pixel_um"),
        ({"full_well": 1e4, "dark_signal": 5}, ConfigError, "'dark_signal': expected with f_number"),
        ({"full_well": 1e4, "offset_dn": 5000}, ConfigError, "'offset_dn': expected less than 4095"),
        ([1], InputError, "expected a JSON object"),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(tmp_path, values, error, words):
    path = tmp_path / "sensor.json"
    path.write_text(json.dumps(values))
    with pytest.raises(error) as found:
        read_sensor(str(path))
    assert words in str(found.value)


def test_an_unknown_preset_lists_the_known_ones():
    with pytest.raises(RegistryError, match="mardi"):
        read_sensor("nosuch")


SUN = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 35.0}
POSE = {"position": (LON, LAT, 2500.0), "fov_deg": 8.0, "size_px": (60, 40)}


def test_render_writes_the_dn_that_the_renderer_gives(hilly_map, tmp_path, monkeypatch, capsys):
    path, *_ = hilly_map
    view = ("--position", f"{LON},{LAT},2500", "--fov", "8", "--size", "60,40", "--sensor", "mardi", "--quiet")
    sun = ("--sun-azimuth", "100", "--sun-elevation", "35")
    for name in ("a", "b"):
        code, error = lunargr_render(monkeypatch, capsys, path, *view, *sun, "-o", tmp_path / name / "v.exr")
        assert code == 0, error
    a, b = (cv2.imread(str(tmp_path / name / f"v{DN}"), cv2.IMREAD_UNCHANGED) for name in ("a", "b"))
    assert a.dtype == np.uint16 and np.array_equal(a, b) and a.shape == (40, 60)
    with render.Renderer(path, "mardi") as renderer:
        first, again, other = (renderer.view(POSE, SUN, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.dn, again.dn) and not np.array_equal(first.dn, other.dn)
    sensor = read_sensor("mardi")
    bright = np.percentile(first.image[first.image > 0], 99.5)
    slope = np.polyfit(first.image.ravel(), first.dn.ravel(), 1)[0]
    assert slope == pytest.approx(0.7 * sensor.full_scale / sensor.gain / bright, rel=0.02)


def test_a_map_seen_from_above_has_no_sensor(hilly_map, tmp_path, monkeypatch, capsys):
    arguments = ("--view", "ortho", "--sensor", "mardi", "--sun-azimuth", "100", "--sun-elevation", "35")
    code, error = lunargr_render(monkeypatch, capsys, hilly_map[0], *arguments, "-o", tmp_path / "v.exr", "--quiet")
    assert code == 3 and "--sensor" in error and not list(tmp_path.glob("v*"))


@pytest.mark.slow
def test_diagnose_finds_the_blur_of_a_sensor(tmp_path):
    """Optics of 1.6 px, in DN, on the way that a user goes."""
    sensor = {"full_well": 30000, "read_noise": 30, "auto_level": 0.5, "offset_dn": 60, "psf_sigma_px": 1.6}
    (tmp_path / "sensor.json").write_text(json.dumps(sensor))
    scene = "simulate -o scene --size-px 700 --images 10 --hidden none --sensor sensor.json --seed 4"
    for line in (
        scene,
        "ingest scene/dem.tif --images scene/images.csv --gsd 5 -o scene.h5",
        "sample scene.h5 -o crops.h5 --crop 128",
        "project crops.h5 -o pairs.h5",
        "diagnose pairs.h5 -o diagnosis.h5 --json answer.json",
    ):
        done = lunargr(*line.split(), "--quiet", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    answer = json.loads((tmp_path / "answer.json").read_text())
    assert [cause["effect"] for cause in answer["causes"]] == ["psf_blur"]
