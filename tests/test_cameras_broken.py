"""Camera models that are broken or lack something are refused in one line."""

from __future__ import annotations

import copy
import json

import pytest

from schemas.errors import GeometryError, InputError, LunargrError, RegistryError
from stages.physics.cameras import camera_from_document, open_camera


@pytest.fixture(scope="module")
def isd(shared):
    return json.loads((shared / "oracles/ale_lrolroc_M103595705LE.isd.json").read_text())


NEEDED = (
    "image_lines",
    "image_samples",
    "center_ephemeris_time",
    "line_scan_rate",
    "focal_length_model.focal_length",
    "focal2pixel_lines",
    "detector_center.sample",
    "detector_sample_summing",
    "starting_detector_sample",
    "optical_distortion",
    "radii.semimajor",
    "instrument_position.positions",
    "instrument_pointing.quaternions",
    "body_rotation.ephemeris_times",
    "sun_position.positions",
)


@pytest.mark.parametrize("key", NEEDED)
def test_a_missing_key_is_named(isd, key):
    document = copy.deepcopy(isd)
    *parents, last = key.split(".")
    here = document
    for parent in parents:
        here = here[parent]
    del here[last]
    with pytest.raises(InputError, match=rf"nac.json: expected the key '{key}'") as caught:
        camera_from_document(document, "nac.json")
    assert "\n" not in str(caught.value)


def broken(name):
    def cut(d, table):
        for key in ("ephemeris_times", "positions", "velocities", "quaternions", "angular_velocities"):
            if key in d[table]:
                d[table][key] = d[table][key][:200]

    def edit(d):
        if name == "quaternion":
            d["instrument_pointing"]["quaternions"][7] = [0.5, 0.5, 0.5, 0.9]
        elif name == "times":
            d["line_scan_rate"] = [[0.5, 3.0, 0.001]]
        elif name == "positions":
            cut(d, "instrument_position")
        elif name == "pointing":
            cut(d, "instrument_pointing")
        elif name == "lengths":
            d["instrument_position"]["positions"] = d["instrument_position"]["positions"][:-1]
        elif name == "order":
            d["body_rotation"]["ephemeris_times"] = d["body_rotation"]["ephemeris_times"][::-1]
        elif name == "rate":
            d["line_scan_rate"] = [[0.5, -0.2, 0.0]]
        elif name == "distortion":
            d["optical_distortion"] = {"brown": {"coefficients": [0]}}
        elif name == "model":
            d["name_model"] = "USGS_ASTRO_SAR_SENSOR_MODEL"
        elif name == "nan":
            d["focal_length_model"]["focal_length"] = float("nan")
        elif name == "still":
            d["instrument_position"]["positions"] = [d["instrument_position"]["positions"][0]] * 401
            d["instrument_position"].pop("velocities")
            for table in ("instrument_pointing", "body_rotation"):
                d[table]["quaternions"] = [d[table]["quaternions"][0]] * len(d[table]["quaternions"])
        return d

    return edit


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("quaternion", GeometryError, r"'instrument_pointing.quaternions': expected unit quaternions.*number 8"),
        ("times", InputError, "expected 'instrument_position' to cover the image's times"),
        ("positions", InputError, "expected 'instrument_position' to cover the image's times"),
        ("pointing", InputError, "expected 'instrument_pointing' to cover the image's times"),
        ("lengths", InputError, "expected 401 entries in 'instrument_position.positions'"),
        ("order", InputError, "expected rising times in 'body_rotation.ephemeris_times'"),
        ("rate", InputError, "line times other than 0"),
        ("distortion", RegistryError, "unknown distortion model 'brown'; choose one of: centred"),
        ("model", RegistryError, "unknown camera 'USGS_ASTRO_SAR_SENSOR_MODEL'"),
        ("nan", InputError, "finite number in 'focal_length_model.focal_length'"),
        ("still", GeometryError, "expected a camera that moves over the ground"),
    ],
)
def test_broken_isds_are_refused_in_one_line(isd, name, error, message):
    with pytest.raises(error, match=message) as caught:
        camera_from_document(broken(name)(copy.deepcopy(isd)), "nac.json")
    assert str(caught.value).startswith("nac.json") and "\n" not in str(caught.value)


def test_cubes_without_a_camera_are_told(shared):
    for name, message in (
        ("ldem_4.cub", "found a map-projected one; leave 'camera' empty"),
        ("wac_backplanes.reduced.cub", "'WAC-VIS'"),
    ):
        with pytest.raises(LunargrError, match=message):
            open_camera(shared / "data/formats" / name)
