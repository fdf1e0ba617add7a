"""ISD cameras against USGSCSM's own numbers and an LROC NAC frame that ISIS went over."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest

from schemas.errors import LunargrError
from stages.physics import photometry
from stages.physics.cameras import camera_from_document, distortion, open_camera

LINE_SCAN = {
    "tough": ("usgscsm_toughLroNacLineScan.isd.json", "usgscsm_lro_nac_tough_image_ground.csv"),
    "M103595705LE": ("ale_lrolroc_M103595705LE.isd.json", "usgscsm_lro_nac_M103595705LE_image_ground.csv"),
}


@pytest.fixture(scope="module", params=LINE_SCAN)
def nac(request, shared):
    isd, table = LINE_SCAN[request.param]
    return open_camera(shared / "oracles" / isd), np.genfromtxt(shared / "oracles" / table, delimiter=",", names=True)


def columns(table, *names):
    return np.stack([table[n] for n in names], axis=-1)


def test_image_to_ground_agrees_with_usgscsm(nac):
    camera, table = nac
    ground = camera.image_to_ground(table["line"], table["samp"], table["height_m"])
    error = np.linalg.norm(ground - columns(table, "X_m", "Y_m", "Z_m"), axis=-1)
    assert error.max() < 5e-3


def test_ground_to_image_agrees_with_usgscsm(nac):
    camera, table = nac
    line, sample = camera.ground_to_image(columns(table, "X_m", "Y_m", "Z_m"))
    np.testing.assert_allclose(line, table["g2i_line"], atol=1e-3)
    np.testing.assert_allclose(sample, table["g2i_samp"], atol=1e-3)


def test_time_position_and_sun_agree_with_usgscsm(nac):
    camera, table = nac
    np.testing.assert_allclose(camera.times(table["line"]), table["time_s"], atol=1e-9)
    np.testing.assert_allclose(
        camera.position(table["line"]), columns(table, "sensor_X_m", "sensor_Y_m", "sensor_Z_m"), atol=5e-3
    )
    to_ground = columns(table, "X_m", "Y_m", "Z_m") - camera.sun_position(table["line"])
    to_ground /= np.linalg.norm(to_ground, axis=-1, keepdims=True)
    expected = columns(table, "sun_to_ground_x", "sun_to_ground_y", "sun_to_ground_z")
    np.testing.assert_allclose(to_ground, expected, atol=1e-8)


def test_round_trip_is_exact(nac, rng):
    camera, _ = nac
    line, sample = rng.uniform(0, camera.lines, 20000), rng.uniform(0, camera.samples, 20000)
    back = camera.ground_to_image(camera.image_to_ground(line, sample, rng.uniform(-4000, 4000, 20000)))
    np.testing.assert_allclose(back[0], line, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back[1], sample, rtol=0, atol=1e-6)


def test_no_line_looks_at_other_places(nac):
    camera, _ = nac
    far = camera.image_to_ground(camera.lines / 2, camera.samples / 2) * -1.0
    line, sample = camera.ground_to_image(np.stack([far, np.full(3, np.nan)]))
    assert not camera.inside(line, sample).any()


def test_both_scan_directions_are_the_same_camera_upside_down(shared, rng):
    """Lines counted against time (a negative line time) must see what the forward camera sees in the mirrored line."""
    document = json.loads((shared / "oracles/ale_lrolroc_M103595705LE.isd.json").read_text())
    forward = camera_from_document(document, "forward")
    first, start, rate = document["line_scan_rate"][0]
    document["line_scan_rate"] = [[first, start + document["image_lines"] * rate, -rate]]
    backward = camera_from_document(document, "backward")
    line, sample = rng.uniform(0, 400, 500), rng.uniform(0, 5064, 500)
    points = forward.image_to_ground(line, sample, 100.0)
    np.testing.assert_allclose(backward.image_to_ground(400 - line, sample, 100.0), points, atol=1e-6)
    back = backward.ground_to_image(points)
    np.testing.assert_allclose(back, [400 - line, sample], atol=1e-6)


def test_line_times_may_change_within_the_image(shared, rng):
    document = json.loads((shared / "oracles/ale_lrolroc_M103595705LE.isd.json").read_text())
    first, start, rate = document["line_scan_rate"][0]
    plain = camera_from_document(document, "plain")
    document["line_scan_rate"] = [[first, start, rate], [first + 100, start + 100 * rate, rate / 2]]
    camera = camera_from_document(document, "two rates")
    line, sample = rng.uniform(100, 400, 200), rng.uniform(0, 5064, 200)
    points = camera.image_to_ground(line, sample)
    np.testing.assert_allclose(points, plain.image_to_ground(100 + (line - 100) / 2, sample), atol=1e-6)
    np.testing.assert_allclose(camera.ground_to_image(points), [line, sample], atol=1e-6)


# --- what ALE writes ------------------------------------------------------------------------------------------------

REFUSED = {
    "apolloPanImage": "expected 'instrument_position' to cover the image's times",
    "cassis": "expected detector summing above 0",
    "hayabusaamica": "found determinant 6944.44 and 0.1208; is the length in metres",
    "mgsmocna": "expected 'instrument_pointing' to cover the image's times",
    "msl": "expected a camera in orbit, found a CAHVOR model",
}
# what USGSCSM itself is not exact to, m: its undistortion stops early
USGSCSM_ERROR = {"dawnfc": 0.02}
# USGSCSM was run on the centre that the ISD gives, x and y of BORESIGHT
CENTRE_TAKEN_ELSEWHERE = {"apollometric": (11450.5, 11450.5), "nhlorri": (511.5, 511.5)}
ALE = sorted(
    [
        "apolloPanImage",
        "apollometric",
        "c1637937",
        "cassiniiss",
        "cassis",
        "chandrayaan2_ohrc",
        "chandrayaan2_tmc2",
        "clem_hires",
        "clem_nir",
        "clem_uvvis",
        "ctx",
        "dawnfc",
        "f004a47",
        "f735a00",
        "galileossi",
        "hayabusa2",
        "hayabusaamica",
        "hirise",
        "kaguyami_isis",
        "kaguyatc",
        "lohighcamera",
        "lomediumcamera",
        "lrolroc",
        "mariner10",
        "messmdis",
        "mexsrc",
        "mgsmocna",
        "msi",
        "msl",
        "nhlorri",
        "osirisrex",
        "themisvis",
    ]
)


@pytest.fixture(scope="module")
def usgscsm_ground(shared):
    """USGSCSM's ground points by ISD: (n, 10) of line, sample, height, ground, image coordinates back, camera's place."""
    table = {}
    for name in ("usgscsm_ale_isds_image_ground.csv", "usgscsm_apollo_cubes_image_ground.csv"):
        with (shared / "oracles" / name).open() as file:
            for isd, *numbers in csv.reader(file):
                if isd != "isd":
                    table.setdefault(isd.split("~")[0], []).append([float(n or "nan") for n in numbers])
    return {name: np.array(rows) for name, rows in table.items()}


@pytest.mark.parametrize("name", ALE)
def test_what_ale_writes_is_read_as_usgscsm_reads_it_or_refused(shared, usgscsm_ground, name):
    document = json.loads((shared / f"oracles/ale_isds/{name}.json").read_text())
    if name in REFUSED:
        with pytest.raises(LunargrError, match=REFUSED[name]) as caught:
            camera_from_document(document, name)
        assert "\n" not in str(caught.value)
        return
    if name in CENTRE_TAKEN_ELSEWHERE:
        camera = camera_from_document(document, name)
        assert camera.detector.centre == CENTRE_TAKEN_ELSEWHERE[name] and "CCD_CENTER" in camera.notes[0]
        del document["naif_keywords"]
    camera = camera_from_document(document, name)
    assert not camera.notes
    if name not in usgscsm_ground:  # no outside numbers: galileossi, lohighcamera
        return
    line, sample, height = usgscsm_ground[name][:, :3].T
    ground, place = usgscsm_ground[name][:, 3:6], usgscsm_ground[name][:, 8:11]
    # doubles hold 1e-16 of a distance, and grazing rays stretch that
    tolerance = 1e-4 + 1e-12 * np.linalg.norm(place, axis=-1) + USGSCSM_ERROR.get(name, 0.0)
    assert (np.linalg.norm(camera.position(line) - place, axis=-1) < tolerance).all()
    assert (np.linalg.norm(camera.image_to_ground(line, sample, height) - ground, axis=-1) < tolerance).all()
    again = camera.image_to_ground(*camera.ground_to_image(ground), height)  # framelets overlap: compare on the ground
    assert (np.linalg.norm(again - ground, axis=-1) < tolerance).all()


@pytest.mark.parametrize("number", [297, 298, 299])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_z_axis_away_from_the_ground_is_looked_along_backwards(shared, usgscsm_ground, number, sign):
    """Apollo Metric ISDs, whether or not their author made the focal length negative."""
    document = json.loads((shared / f"oracles/isd_variants/AS15-M-0{number}_negfocal.json").read_text())
    document["focal_length_model"]["focal_length"] *= sign
    rows = usgscsm_ground[f"AS15-M-0{number}_crop"]
    points = camera_from_document(document, "apollo").image_to_ground(*rows[:, :3].T)
    assert np.linalg.norm(points - rows[:, 3:6], axis=-1).max() < 1e-6


def frame_isd(**changes):
    """A camera 100 km above (0 E, 0 N): x east, y north, z up; 10 px/mm, focal length 50 mm."""
    times, still = [0.0], {"quaternions": [[1.0, 0, 0, 0]], "ephemeris_times": [0.0]}
    return {
        "name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL",
        "image_lines": 100,
        "image_samples": 100,
        "center_ephemeris_time": 0.0,
        "radii": {"semimajor": 1000.0, "semiminor": 1000.0, "unit": "km"},
        "body_rotation": still,
        "instrument_pointing": still | {"constant_rotation": [0, 1, 0, 0, 0, 1, 1, 0, 0]},
        "instrument_position": {"positions": [[1100.0, 0, 0]], "ephemeris_times": times, "unit": "km"},
        "sun_position": {"positions": [[1e8, 0, 0]], "ephemeris_times": times, "unit": "km"},
        "focal_length_model": {"focal_length": 50.0},
        "focal2pixel_lines": [0.0, 0.0, 10.0],
        "focal2pixel_samples": [0.0, 10.0, 0.0],
        "detector_center": {"line": 50.0, "sample": 50.0},
        "detector_line_summing": 1,
        "detector_sample_summing": 1,
        "starting_detector_line": 0,
        "starting_detector_sample": 0,
        "optical_distortion": {"radial": {"coefficients": [0.0, 0.0, 0.0]}},
    } | changes


def test_the_optical_axis_decides_even_where_the_image_lies_beside_it():
    """z up: east of the axis is at larger samples. A crop 50 degrees aside shows no ground behind the middle pixel."""
    point = np.array([1e6 * math.cos(0.01), 1e6 * math.sin(0.01), 0.0])
    expected = 50 + 500 * point[1] / (1.1e6 - point[0])
    assert camera_from_document(frame_isd(), "up").ground_to_image(point)[1] == pytest.approx(expected)
    aside = frame_isd(starting_detector_sample=600)
    assert camera_from_document(aside, "aside").ground_to_image(point)[1] == pytest.approx(expected - 600)


def test_no_ray_meets_ground_below_the_body_s_middle():
    camera = camera_from_document(frame_isd(), "up")
    assert np.isnan(camera.image_to_ground(50, 50, -1.1e6)).all()
    assert np.isfinite(camera.image_to_ground(50, 50, -0.9e6)).all()


# --- USGSCSM's unit tests -------------------------------------------------------------------------------------------


def unit_tests(shared):
    with (shared / "oracles/usgscsm_unit_test_expected.csv").open() as file:
        return list(csv.DictReader(file))


def expected_ground(shared, name):
    rows = [r for r in unit_tests(shared) if r["test"] == name]
    assert len(rows) == 3
    return [float(r["expected"]) for r in rows], float(rows[0]["tolerance"])


def test_nac_distortion_is_usgscsms(shared):
    rows = {
        (r["test"].split()[-1], r["quantity"]): float(r["expected"]) for r in unit_tests(shared) if "Nac" in r["test"]
    }
    k = np.array([1.81e-5])
    ux, uy = distortion.undistort_arrays(distortion.LRO_NAC, k, np.array(0.0), np.array(17.724))
    assert ux == rows["removeDistortion", "ux"]
    assert uy == pytest.approx(rows["removeDistortion", "uy"], abs=1e-8)
    _, dy = distortion.distort_arrays(distortion.LRO_NAC, k, np.array(0.0), np.array(17.6237922244))
    assert dy == pytest.approx(rows["applyDistortion", "dy"], abs=1e-8)


@pytest.mark.parametrize(
    ("name", "isd", "line", "sample", "focal_length"),
    [
        ("ConstVelocityLineScan.Center", "constVelocityLineScan", 8, 8, None),
        ("ConstVelocityLineScan.OffBody", "constVelocityLineScan", 0, 4, None),
        ("OrbitalLineScan.Center", "orbitalLineScan", 8.5, 8, None),
        ("Frame.Center", "simpleFramerISD", 7.5, 7.5, None),
        ("Frame.SlightlyOffCenter", "simpleFramerISD", 7.5, 6.5, None),
        ("Frame.OffBody1", "simpleFramerISD", 15, 0, None),
        ("Frame.OffBody2", "simpleFramerISD", 0, 15, None),
        ("Frame.OffBody3", "simpleFramerISD", 0, 0, None),
        ("Frame.OffBody4", "simpleFramerISD", 15, 15, None),
        ("OrbitalFrame.Center", "orbitalFramer", 8, 8, None),
        ("FrameState.FL500_OffBody4", "simpleFramerISD", 15, 15, 500),
        ("FrameState.FL500_OffBody3", "simpleFramerISD", 0, 0, 500),
    ],
)
def test_usgscsm_unit_tests(shared, name, isd, line, sample, focal_length):
    document = json.loads((shared / f"oracles/usgscsm_{isd}.isd.json").read_text())
    if focal_length is not None:
        document["focal_length_model"]["focal_length"] = focal_length
    if isd.startswith(
        "orbital"
    ):  # made for a camera that looks out of its back, along -(x, y, f): ISIS's is (x, y, -f)
        for key in ("focal2pixel_lines", "focal2pixel_samples"):
            document[key] = [-c for c in document[key]]
    camera = camera_from_document(document, isd)
    expected, tolerance = expected_ground(shared, name)
    ground = camera.image_to_ground(line, sample, missing="nearest")
    np.testing.assert_allclose(ground, expected, rtol=0, atol=max(tolerance, 1e-8))


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        (distortion.RADIAL, [1e-3, 2e-5, -3e-9]),
        (
            distortion.TRANSVERSE,
            [0.01, 1, 1e-3, 1e-5, 2e-5, 0, 1e-7, 0, 0, 2e-7, -0.02, 0, 1, 0, 1e-5, 0, 0, 0, 1e-7, 0],
        ),
        (distortion.LRO_NAC, [1.81e-5]),
        (distortion.DAWN_FC, [8.4e-6]),
        (distortion.KAGUYA_LISM, [0.01, -9.6e-4, 1e-4, 2e-6, 1e-8, -0.02, 1e-3, 2e-5, 3e-7, 0]),
        (distortion.SHADOWCAM, [-1.741e-5]),
        (distortion.LUNAR_ORBITER, [-3e-6, 8e-7, -1.11, 0.3, 2.7963e-4, -2.869e-8]),
        (distortion.METRIC, [-6e-3, -2e-3, -1.3361854e-6, 5.2261757e-10, -5.07e-14, -5.4958195e-7, -4.6e-11, 2.965907]),
        (distortion.UVVIS, [0.1, -0.2, 0.0, -2.422842e-5, 0.0, 2.255006e-5, 2.1089e-5]),
        (distortion.CENTRED, [0.032, -0.032, 4.66e-3, 1.66e-7, -2.4e-9]),
        (distortion.RADTAN, [-0.3, 0.1, 1e-3, -2e-3, -0.02, 0, 0, 0, 50.0]),
        (distortion.FISHEYE, [-0.02, 0.01, -3e-3, 1e-4, 0, 0, 0, 0, 50.0]),
        (distortion.NONE, [0.0]),
    ],
)
def test_distortion_comes_back(model, coefficients, rng):
    k = np.array(coefficients, float)
    x, y = rng.uniform(-18, 18, (2, 200))
    back = distortion.undistort_arrays(model, k, *distortion.distort_arrays(model, k, x, y))
    np.testing.assert_allclose(back, [x, y], atol=1e-11)


def test_distortions_by_their_kernels_formulas():
    """ShadowCam as USGSCSM's own test has it, one radial coefficient as Galileo's kernel, Lunar Orbiter as ISIS has it."""
    read = distortion.read_distortion
    code, k = read({"optical_distortion": {"kplo_shadowcam": {"coefficients": [-1.741e-5]}}}, "isd")
    np.testing.assert_allclose(
        distortion.undistort_arrays(code, k, 0.0, -18.69), [0, -18.69 * (1 - 1.741e-5 * 18.69**2)], rtol=1e-14
    )
    code, k = read({"optical_distortion": {"radial": {"coefficients": [-2.5e-5]}}}, "isd")
    np.testing.assert_allclose(distortion.undistort_arrays(code, k, 3.0, 4.0), np.array([3, 4]) * (1 + 2.5e-5 * 25))
    high = {"perspective_x": -3e-6, "perspective_y": 8e-7, "center_point_x": -1.11, "center_point_y": 0.3}
    isd = {"optical_distortion": {"lunarorbiter": high}, "naif_keywords": {"INS-533001_OD_K": [2.8e-4, -2.9e-8, 0.0]}}
    code, k = read(isd, "isd")
    px, py = np.array([60.0, -20.0]) * (1 - 3e-6 * 60 + 8e-7 * -20)
    scale = 2.8e-4 - 2.9e-8 * ((px + 1.11) ** 2 + (py - 0.3) ** 2)
    np.testing.assert_allclose(
        distortion.undistort_arrays(code, k, 60.0, -20.0),
        [px - scale * (px + 1.11), py - scale * (py - 0.3)],
        rtol=1e-14,
    )


# --- the NAC frame that ISIS went over ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def crop(shared):
    camera = open_camera(shared / "data/formats/M143947267L.cal.echo.crop.cub")
    expected = json.loads((shared / "oracles/nac_M143947267LE_crop_geometry_and_expected.json").read_text())
    return camera, expected, np.load(shared / "oracles/nac_M143947267LE_crop_iof_400x400.npy")


def crop_geometry(camera):
    line, sample = 299.5, 300.5  # ISIS line 300, and the sample of index 300
    point = camera.image_to_ground(line, sample)
    up = point / np.linalg.norm(point)
    to_sun = camera.sun_position(line) - point
    to_camera = camera.position(line) - point
    to_sun, distance = to_sun / np.linalg.norm(to_sun), np.linalg.norm(to_camera)
    to_camera = to_camera / distance
    angles = np.arccos([up @ to_sun, up @ to_camera, to_sun @ to_camera])
    return point, angles, distance


def test_the_nac_cubes_own_tables_make_its_camera(crop):
    camera, expected, _ = crop
    truth = expected["independent_check"]["geometry"]
    point, angles, distance = crop_geometry(camera)
    assert math.degrees(math.asin(point[2] / np.linalg.norm(point))) == pytest.approx(truth["lat"], abs=1e-6)
    assert math.degrees(math.atan2(point[1], point[0])) == pytest.approx(truth["lon"], abs=1e-6)
    np.testing.assert_allclose(np.degrees(angles), [truth["inc"], truth["ema"], truth["phase"]], atol=1e-5)
    assert distance / 1000 == pytest.approx(truth["range"], abs=1e-5)
    assert camera.ephemeris_time(299.5) == pytest.approx(truth["et"], abs=1e-6)


@pytest.mark.parametrize(("number", "model"), [(0, "lroc_empirical_2019"), (1, "lroc_empirical_2014")])
def test_isis_photometric_correction_of_the_crop(crop, number, model):
    """ISIS lronacpho: the pixel, normalised to incidence 30, emission 0, phase 30 deg."""
    camera, expected, image = crop
    truth = expected["expected"][number]
    assert f"{model[-4:]}" in truth["algorithm"]
    _, (incidence, emission, phase), _ = crop_geometry(camera)
    standard = photometry.evaluate(model, {}, math.radians(30), 0.0, math.radians(30))
    seen = photometry.evaluate(model, {}, incidence, emission, phase)
    value = image[truth["pixel_line_1based"] - 1, truth["pixel_sample_0based_index"]] * standard / seen
    assert value == pytest.approx(truth["value"], abs=truth["tol"])
