"""Cameras that move while they take a picture, against closed forms over a plane with one bright half."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from relief import RADIUS
from render_scene import LAT, LON, SUN, lunargr_render, make_grid, write_dem, write_svbrdf

from schemas.errors import ConfigError, InputError
from stages import render
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.detector import read_sensor
from stages.physics.detector.readout import blur
from stages.physics.maps.grid import unit_vectors
from stages.render.files import DN
from stages.render.motion import Moving, rates, turned
from stages.render.pictures import read_exr

HEIGHT, SIZE, FOV = 400.0, 128, 16.0
FOCAL = SIZE / 2 / math.tan(math.radians(FOV / 2))
POSE = {"position": (LON, LAT, HEIGHT), "fov_deg": FOV, "size_px": (SIZE, SIZE)}
NOON = {"sun_azimuth_deg": 90.0, "sun_elevation_deg": 60.0}
QUIET = {"full_well": 1e8, "bits": 16, "auto_level": 0.9}  # noise that no test sees


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    """A plane, the eastern half of which is bright: 0.5 m a pixel, the edge in the middle."""
    grid = make_grid(400, 400, 0.5)
    albedo = np.where(np.arange(400) < 200, 0.1, 0.4) * np.ones((400, 1))
    path = tmp_path_factory.mktemp("plane") / "plane.h5"
    return write_svbrdf(path, grid, np.zeros((400, 400)), albedo[None], "lambert")


def sensor_file(folder, **keys):
    path = folder / "sensor.json"
    path.write_text(json.dumps(QUIET | keys))
    return path


def exposed(plane, tmp_path, pose=POSE, **keys):
    with render.Renderer(plane, sensor_file(tmp_path, **keys), samples=2) as renderer:
        frame = renderer.view(pose, NOON)
    return frame, frame.dn.astype(float)


def edges(picture):
    """Middle, and variance about it, of the edge in each line, px."""
    near = slice(SIZE // 2 - 24, SIZE // 2 + 24)
    step, place = np.diff(picture, axis=1)[:, near], np.arange(1, picture.shape[1])[near]
    middle = (step * place).sum(1) / step.sum(1)
    return middle, (step * (place - middle[:, None]) ** 2).sum(1) / step.sum(1)


@pytest.mark.parametrize(
    ("rate", "length"),
    [
        ({"velocity": (30.0, 0.0, 0.0)}, 30.0 * 0.1 * FOCAL / HEIGHT),  # speed x exposure x focal length / distance
        ({"velocity": (0.0, 30.0, 0.0)}, 0.0),
        ({"spin_deg": (0.0, 1.5, 0.0)}, math.radians(1.5) * 0.1 * FOCAL),
        ({"velocity": (90.0, 0.0, 0.0)}, 90.0 * 0.1 * FOCAL / HEIGHT),
    ],
)
def test_an_edge_is_smeared_over_the_way_that_the_image_goes(plane, tmp_path, rate, length):
    turned_a_little = POSE | {"roll_deg": 5.0}  # so that the edge lies everywhere within a pixel
    still, _ = exposed(plane, tmp_path, turned_a_little, exposure_s=0.1)
    moving, dn = exposed(plane, tmp_path, turned_a_little | rate, exposure_s=0.1)
    _, before = edges(still.dn.astype(float))
    place, after = edges(dn)
    middle = slice(SIZE // 2 - 46, SIZE // 2 + 46)  # eight pixels of the edge's way
    assert (after - before)[middle].mean() == pytest.approx(length**2 / 12, rel=0.03, abs=0.01)
    assert place[middle].mean() == pytest.approx(edges(still.dn.astype(float))[0][middle].mean(), abs=0.1)
    np.testing.assert_array_equal(moving.image, still.image)


def test_lines_read_one_after_the_other_shear_the_edge(plane, tmp_path):
    """Skew: line time x image rate; all channels are those of the sheared image."""
    pose = POSE | {"velocity": (60.0, 0.0, 0.0)}
    frame, dn = exposed(plane, tmp_path, pose, line_time_s=0.002)
    place, _ = edges(dn)
    slope = np.polyfit(np.arange(SIZE), place, 1)[0]
    assert slope == pytest.approx(-60.0 * 0.002 * FOCAL / HEIGHT, rel=0.01)
    assert place[SIZE // 2] == pytest.approx(SIZE / 2, abs=0.3)
    line, sample = (v.ravel() for v in np.mgrid[0:SIZE:9, 0:SIZE:9])
    ground = unit_vectors(
        *(frame_plane[line, sample].astype(float) for frame_plane in (frame.longitude_deg, frame.latitude_deg))
    )
    seen = frame.camera.ground_to_image(ground * RADIUS)
    np.testing.assert_allclose(seen[0], line + 0.5, atol=0.4)  # degrees are float32: 0.1 m
    np.testing.assert_allclose(seen[1], sample + 0.5, atol=0.4)


def test_rays_of_a_turning_camera_come_back_to_their_pixels(rng):
    still = Pinhole(80, 60, (90.0, 95.0), (31.0, 42.0), np.array([RADIUS + 900.0, 0, 0]), np.diag([-1.0, 1.0, -1.0]))
    camera = Moving(
        **{k: getattr(still, k) for k in ("lines", "samples", "focal_px", "principal_point_px", "centre", "rotation")},
        velocity=np.array([-3.0, 8.0, 5.0]), spin=np.array([0.02, -0.03, 0.05]), line_time=0.01,
    )  # fmt: skip
    line, sample = rng.uniform(0, 80, 50), rng.uniform(0, 60, 50)
    origins, directions = camera.rays(line, sample)
    back = camera.ground_to_image(origins + 850.0 * directions)
    np.testing.assert_allclose(back, [line, sample], atol=1e-6)


def test_rates_lead_from_one_pose_to_the_next(rng):
    first = Pinhole(8, 8, (9.0, 9.0), (4.0, 4.0), np.array([RADIUS, 0, 0]), cv2.Rodrigues(rng.normal(size=3))[0])
    velocity, spin = rng.normal(size=3), 0.1 * rng.normal(size=3)
    names = ("lines", "samples", "focal_px", "principal_point_px", "centre", "rotation")
    moving = Moving(**{k: getattr(first, k) for k in names}, velocity=velocity, spin=spin)
    found = rates(first, moving.at(2.5), 2.5)
    np.testing.assert_allclose(found, [velocity, spin], atol=1e-9)
    matrix = cv2.Rodrigues(spin)[0]
    np.testing.assert_allclose(turned(np.eye(3), spin), matrix.T, atol=1e-12)


def test_a_trajectory_moves_as_its_rows_do(plane, tmp_path, monkeypatch, capsys):
    """30 m/s to the east between rows, by `time_s` and by UTC; height above the ground; the camera's own intrinsics."""
    step = math.degrees(30.0 / (RADIUS + HEIGHT) / math.cos(math.radians(LAT)))
    camera = {
        "type": "pinhole", "focal_px": FOCAL, "principal_point_px": [SIZE / 2, SIZE / 2], "size_px": [SIZE, SIZE],
        "position_mcmf": [RADIUS + 5, 0, 0], "rotation_camera_to_mcmf": [0, 0, 0, 1], "distortion": {"k1": -0.1},
    }  # fmt: skip
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    times = {"time_s": ["0", "1", "2"], "time": [f"2024-05-01T00:00:0{k}" for k in range(3)]}
    found = {}
    for name, cells in times.items():
        rows = [f"v{k},{LON + step * (k - 1)!r},{LAT},{HEIGHT},{cell}" for k, cell in enumerate(cells)]
        (tmp_path / "t.csv").write_text(f"view_id,longitude_deg,latitude_deg,height_m,{name}\n" + "\n".join(rows))
        sun = SUN if name == "time_s" else ()
        sensor = sensor_file(tmp_path, exposure_s=0.1)
        arguments = ("--trajectory", tmp_path / "t.csv", *sun, "--sensor", sensor, "--camera", tmp_path / "camera.json")
        code, error = lunargr_render(
            monkeypatch, capsys, plane, *arguments, "-o", tmp_path / name, "--quiet", "--samples", "1"
        )
        if name == "time" and "below" in error:
            continue  # by night
        assert code == 0, error
        found[name] = json.loads((tmp_path / name / "cameras.json").read_text())["views"]
    for view in found["time_s"]:
        assert np.linalg.norm(view["motion"]["velocity_mcmf"]) == pytest.approx(30.0, rel=1e-4)
        assert view["distortion"]["k1"] == -0.1 and view["motion"]["exposure"] == 0.1
        assert np.linalg.norm(view["position_mcmf"]) == pytest.approx(RADIUS + HEIGHT, abs=1e-3)
    image = oiio.ImageInput.open(str(tmp_path / "time_s" / "v1.exr"))
    assert json.loads(image.spec().getattribute("lunargr:motion")) == found["time_s"][1]["motion"]
    image.close()
    dn = cv2.imread(str(tmp_path / "time_s" / f"v1{DN}"), cv2.IMREAD_UNCHANGED).astype(float)
    _, width = edges(dn)
    assert width[SIZE // 2] == pytest.approx((3.0 * FOCAL / HEIGHT) ** 2 / 12 + 1 / 6, rel=0.1)  # with the pixels' own


def test_a_kernel_is_the_image_of_a_point(tmp_path):
    weights = np.array([[0, 1, 0], [2, 4, 0], [0, 0, 1.0]])
    spot = np.zeros((9, 9), np.float32)
    spot[4, 4] = 8.0
    np.save(tmp_path / "psf.npy", weights)
    np.savetxt(tmp_path / "psf.txt", weights)
    for given in (weights.tolist(), "psf.npy", "psf.txt"):
        seen = blur(read_sensor(str(sensor_file(tmp_path, psf_kernel=given))), spot)
        np.testing.assert_allclose(seen[3:6, 3:6], weights, atol=1e-6)
        assert seen.sum() == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("keys", "error", "words"),
    [
        ({"psf_kernel": [[1, 2]]}, InputError, "an odd number of rows"),
        ({"psf_kernel": [[-1.0]]}, InputError, "weights of at least 0"),
        ({"psf_kernel": [["a"]]}, InputError, "rows of numbers"),
        ({"psf_kernel": "nosuch.npy"}, InputError, "no such file"),
        ({"psf_kernel": [[1.0]], "psf_sigma_px": 1.0}, ConfigError, "found both"),
        ({"line_time_s": -1}, InputError, "'line_time_s'"),
    ],
)
def test_optics_and_lines_that_cannot_be_are_refused(tmp_path, keys, error, words):
    with pytest.raises(error, match=words):
        read_sensor(str(sensor_file(tmp_path, **keys)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--velocity", "1,2,3"), "--velocity: expected with a --sensor"),
        (("--velocity", "1,2", "--sensor", "mardi"), "--velocity"),
        (("--spin", "1,2,3", "--sensor", "mardi"), "--spin: expected a sensor with 'exposure_s' or 'line_time_s'"),
        (("--view", "ortho", "--velocity", "1,2,3"), "--velocity"),
    ],
)
def test_motion_that_nothing_shows_is_refused(plane, tmp_path, monkeypatch, capsys, arguments, words):
    place = () if "ortho" in arguments else ("--position", f"{LON},{LAT},400")
    code, error = lunargr_render(monkeypatch, capsys, plane, *place, *arguments, *SUN, "-o", tmp_path / "v.exr")
    assert code == 3 and words in error and error.count("\n") == 1 and not list(tmp_path.glob("v*"))


def test_rows_without_times_have_no_lines_to_shear(plane, tmp_path, monkeypatch, capsys):
    (tmp_path / "t.csv").write_text(f"longitude_deg,latitude_deg,altitude_m\n{LON},{LAT},400\n{LON},{LAT},300\n")
    sensor = sensor_file(tmp_path, line_time_s=0.001)
    code, error = lunargr_render(
        monkeypatch, capsys, plane, "--trajectory", tmp_path / "t.csv", "--sensor", sensor, *SUN, "-o", tmp_path / "v"
    )
    assert code == 3 and "expected two rows with 'time_s' or 'time'" in error


def test_a_line_scan_camera_gives_no_intrinsics(plane, tmp_path, monkeypatch, capsys):
    (tmp_path / "t.csv").write_text(f"longitude_deg,latitude_deg,altitude_m\n{LON},{LAT},400\n")
    camera = {
        "type": "orthographic", "pixel_size": 1.0, "principal_point_px": [4, 4], "size_px": [8, 8],
        "position_mcmf": [RADIUS + 5, 0, 0], "rotation_camera_to_mcmf": [0, 0, 0, 1],
    }  # fmt: skip
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    common = (
        plane,
        "--trajectory",
        tmp_path / "t.csv",
        "--camera",
        tmp_path / "camera.json",
        *SUN,
        "-o",
        tmp_path / "v",
    )
    code, error = lunargr_render(monkeypatch, capsys, *common)
    assert code == 3 and "expected a pinhole camera" in error
    code, error = lunargr_render(monkeypatch, capsys, *common, "--fov", "25")
    assert code == 3 and "--fov" in error


def test_a_dem_of_one_height_renders(tmp_path, monkeypatch, capsys):
    """What moves over it stays in its picture: read back from the EXR, the middle is the place below."""
    dem = write_dem(tmp_path / "dem.tif", make_grid(64, 64, 5.0), np.zeros((64, 64)))
    sensor = sensor_file(tmp_path, exposure_s=0.05, line_time_s=0.001)
    view = ("--dem", dem, "--model", "lambert", "--position", f"{LON},{LAT},300", "--fov", "10", "--size", "21,21")
    code, error = lunargr_render(
        monkeypatch,
        capsys,
        *view,
        "--sensor",
        sensor,
        "--velocity",
        "10,-5,-20",
        "--spin",
        "0,0,10",
        *SUN,
        "-o",
        tmp_path / "v.exr",
    )
    assert code == 0, error
    seen = read_exr(tmp_path / "v.exr")
    assert seen["longitude_deg"][10, 10] == pytest.approx(LON, abs=1e-5)
