"""Frame cameras: closed forms, round trips, derivatives to pose, and what is refused."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest
from camera_rays import image_to_terrain, looking_at

from schemas.errors import GeometryError, InputError, RegistryError
from stages.physics.cameras import camera_from_document, cameras, open_camera
from stages.physics.cameras.base import Camera
from stages.physics.cameras.orthographic import Orthographic
from stages.physics.cameras.pinhole import Pinhole

MOON = 1737400.0
POSITION = np.array([MOON + 60e3, 20e3, -35e3])


def pinhole() -> Pinhole:
    return looking_at(POSITION, [MOON, 1e3, 2e3], math.radians(12), (640, 480))


def orthographic() -> Orthographic:
    camera = pinhole()
    return Orthographic(480, 640, (20.0, 25.0), (320.0, 240.0), POSITION, camera.rotation)


@pytest.fixture(params=[pinhole, orthographic], ids=["pinhole", "orthographic"])
def camera(request: pytest.FixtureRequest) -> Camera:
    return request.param()


def test_nadir_pinhole_is_similar_triangles():
    camera = looking_at([MOON + 1e5, 0, 0], [MOON, 0, 0], math.radians(10), (100, 100))
    line, sample = camera.ground_to_image([[MOON, 500.0, 300.0], [MOON + 1e5 + 1, 0, 0]])
    focal = 50 / math.tan(math.radians(5))
    assert sample[0] == pytest.approx(50 + focal * 500 / 1e5)  # east is to the right, north is up
    assert line[0] == pytest.approx(50 - focal * 300 / 1e5)
    assert np.isnan(line[1]) and np.isnan(sample[1])  # behind the camera


def test_round_trip_at_heights(camera, rng):
    line, sample = rng.uniform(0, camera.lines, 500), rng.uniform(0, camera.samples, 500)
    for height in (-5000.0, 0.0, 8000.0):
        points = camera.image_to_ground(line, sample, height)
        np.testing.assert_allclose(np.linalg.norm(points, axis=-1), MOON + height, atol=1e-6)
        back = camera.ground_to_image(points)
        np.testing.assert_allclose(back[0], line, atol=1e-6)
        np.testing.assert_allclose(back[1], sample, atol=1e-6)
        assert camera.inside(*back).all()


def test_terrain_is_met_where_it_is(camera, rng):
    def height_at(longitude, latitude):
        return 800 * np.sin(longitude * 40) * np.cos(latitude * 37) - 300

    line, sample = rng.uniform(0, camera.lines, 300), rng.uniform(0, camera.samples, 300)
    points = image_to_terrain(camera, line, sample, height_at)
    radius = np.linalg.norm(points, axis=-1)
    longitude = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    latitude = np.degrees(np.arcsin(points[:, 2] / radius))
    np.testing.assert_allclose(radius - MOON, height_at(longitude, latitude), atol=2e-3)
    np.testing.assert_allclose(camera.ground_to_image(points), [line, sample], atol=1e-6)


def test_rays_past_the_body_are_told():
    camera = looking_at([MOON + 1e5, 0, 0], [MOON, 0, 0], math.radians(170), (101, 101))
    points = camera.image_to_ground([50.5, 50.5], [50.5, 100.5])
    assert np.isfinite(points[0]).all() and np.isnan(points[1]).all()
    with pytest.raises(GeometryError, match=r"1 of 2 pixels look past the body.*sample 100\.5"):
        camera.image_to_ground([50.5, 50.5], [50.5, 100.5], missing="error")


def test_documents_come_back(tmp_path):
    camera = pinhole()
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(camera.to_document()))
    again = open_camera(path)
    np.testing.assert_array_equal(again.centre, camera.centre)
    np.testing.assert_array_equal(again.rotation, camera.rotation)
    assert (again.lines, again.samples) == (480, 640)


def test_quaternions_are_rotations_too():
    document = pinhole().to_document()
    half = math.sqrt(0.5)
    document["rotation_camera_to_mcmf"] = [0.0, 0.0, half, half]  # a quarter turn about z
    camera = camera_from_document(document, "camera.json")
    np.testing.assert_allclose(camera.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_other_bodies_by_name_or_radius():
    document = pinhole().to_document()
    assert camera_from_document(document | {"body": "Mars"}, "c").semi_axes == (3389500.0, 3389500.0)
    assert camera_from_document(document | {"body": 255000}, "c").semi_axes == (255000.0, 255000.0)


BROWN = {"k1": -0.21, "k2": 0.06, "p1": 1.2e-3, "p2": -8e-4, "k3": -0.01}
RATIONAL = BROWN | {"k4": 0.02, "k5": -0.01, "k6": 0.003}


@pytest.mark.parametrize(
    "given", [BROWN, RATIONAL, {"model": "fisheye", "k1": -0.04, "k2": 0.01, "k3": -0.004, "k4": 1e-3}]
)
def test_distortion_is_opencvs_both_ways(given, rng):
    document = pinhole().to_document() | {"distortion": given, "focal_px": [500.0, 510.0]}
    camera = camera_from_document(document, "camera.json")
    again = camera_from_document(camera.to_document(), "again")
    points = np.stack([*rng.uniform([[-0.6], [-0.45]], [[0.6], [0.45]], (2, 400)), np.ones(400)], axis=-1)
    matrix = np.array([[500.0, 0, 319.5], [0, 510, 239.5], [0, 0, 1]])  # OpenCV counts from the first pixel's centre
    names = [n for n in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6") if n in given]
    numbers = np.array([given[n] for n in names])
    if given.get("model") == "fisheye":
        numbers = np.array([given[n] for n in ("k1", "k2", "k3", "k4")])
        seen, _ = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), matrix, numbers)
    else:
        seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, numbers)
    sample, line = np.moveaxis(seen.reshape(-1, 2), -1, 0) + 0.5
    for model in (camera, again):
        ground = model.centre + 1e5 * points @ model.rotation.T
        np.testing.assert_allclose(model.ground_to_image(ground), [line, sample], atol=1e-6)
        _, direction = model.rays(line, sample)
        inside = points / np.linalg.norm(points, axis=-1, keepdims=True)
        np.testing.assert_allclose(direction @ model.rotation, inside, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"focal_lenght": 3}, InputError, "unknown key 'focal_lenght'; the keys are: type, "),
        ({"focal_xp": 3}, InputError, "unknown key 'focal_xp', did you mean 'focal_px'"),
        ({"distortion": {"k1": -0.3, "k7": 1}}, InputError, "'distortion': unknown key 'k7'"),
        ({"distortion": [0.1]}, InputError, "expected an object of OpenCV's coefficients"),
        ({"distortion": {"model": "brwon"}}, InputError, "expected the model 'brown' or 'fisheye'"),
        ({"focal_px": None}, InputError, "expected finite numbers in 'focal_px'"),
        ({"focal_px": -3}, GeometryError, "focal lengths above 0"),
        ({"size_px": [640.5, 480]}, InputError, "whole number of pixels"),
        ({"position_mcmf": [1, 2]}, InputError, "expected 3 numbers in 'position_mcmf'"),
        ({"rotation_camera_to_mcmf": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, GeometryError, "not orthonormal"),
        ({"rotation_camera_to_mcmf": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, GeometryError, "a reflection"),
        (
            {"rotation_camera_to_mcmf": [1, 1, 0, 1]},
            GeometryError,
            "expected unit quaternions, found one of length 1.73",
        ),
        ({"type": "no-such-camera"}, RegistryError, "unknown camera 'no-such-camera'; choose one of:"),
        ({"body": "krypton"}, GeometryError, "krypton"),
    ],
)
def test_bad_documents_are_refused_in_one_line(change, error, message):
    with pytest.raises(error, match=message) as caught:
        camera_from_document(pinhole().to_document() | change, "camera.json")
    assert "\n" not in str(caught.value)


def test_missing_keys_and_files_are_named(tmp_path):
    for key in ("focal_px", "principal_point_px", "size_px", "position_mcmf", "rotation_camera_to_mcmf"):
        document = pinhole().to_document()
        del document[key]
        with pytest.raises(InputError, match=f"camera.json: expected the key '{key}'"):
            camera_from_document(document, "camera.json")
    with pytest.raises(InputError, match="no such file"):
        open_camera(tmp_path / "none.json")
    path = tmp_path / "text.json"
    path.write_text("not json")
    with pytest.raises(InputError, match="expected a camera model in JSON"):
        open_camera(path)


def test_the_registry_lists_its_kinds():
    assert {"pinhole", "orthographic"} <= {c.kind for c in cameras()}
