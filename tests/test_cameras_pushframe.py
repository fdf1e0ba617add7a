"""Push-frame cameras: a circular orbit in closed form, USGSCSM's own test values, and from a raw image to pairs."""

from __future__ import annotations

import csv
import json
import math

import h5py
import numpy as np
import pytest
import small_scene
from push_frame import FOCAL_PX, STEP, isd
from raw_frames import photograph, residual, run_all, write_image

from schemas.errors import GeometryError, InputError
from schemas.packing import read
from stages.physics.bodies.ephemeris import AU
from stages.physics.cameras import camera_from_document, cameras
from stages.physics.maps.grid import unit_vectors


def places(points, radius=1e6, orbit=1.05e6, rate=0.012, framelets=30, height=16, overlap=2, samples=16):
    """(framelet in time, line in it, sample) by trigonometry of points (n, 3) on the sphere, nearest framelet's middle."""
    phi = np.arctan2(-points[:, 2], points[:, 0])[:, None] - rate * STEP * np.arange(framelets)
    level = np.hypot(points[:, 0], points[:, 2])[:, None]
    depth = orbit - level * np.cos(phi)
    off = FOCAL_PX * level * np.sin(phi) / depth
    k = np.abs(off).argmin(axis=1)
    rows = np.arange(len(points))
    return k, (height - overlap) / 2 + off[rows, k], samples / 2 - FOCAL_PX * points[:, 1] / depth[rows, k]


def ground(rng, n, radius=1e6, angles=(0.0, 29 * 0.0012), across=7e2):
    phi, y = rng.uniform(*angles, n), rng.uniform(-across, across, n)
    level = np.sqrt(radius**2 - y**2)
    return np.stack([level * np.cos(phi), y, -level * np.sin(phi)], axis=1)


def test_usgscsm_unit_test_values():
    """PushFrameCameraTests.cpp of USGSCSM: the centre of the first framelet, a height above it, and the Sun."""
    camera = camera_from_document(isd(height=12, overlap=0), "isd")
    np.testing.assert_allclose(camera.image_to_ground(6.0, 8.0), [1e6, 0, 0], atol=1e-6)
    line, sample = camera.ground_to_image([1e6, 0.0, 0.0])
    assert (line, sample) == (pytest.approx(6, abs=1e-3), pytest.approx(8, abs=1e-3))
    raised = camera.image_to_ground(6.0, 8.0, 100.0) - camera.image_to_ground(6.0, 8.0)
    assert np.linalg.norm(raised) == pytest.approx(100, abs=0.01)
    at = float(np.flatnonzero(np.isclose(camera.times, 999.4))[0]) * 12 + 6
    np.testing.assert_allclose(camera.sun_position(at), [125e6] * 3, atol=1e-5)
    assert (camera.lines, camera.samples) == (360, 16)


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("reversed_", [False, True])
@pytest.mark.parametrize("overlap", [0, 2])
def test_places_on_the_ground_agree_with_trigonometry(rng, flipped, reversed_, overlap):
    camera = camera_from_document(
        isd(overlap=overlap, framelets_flipped=flipped, framelet_order_reversed=reversed_), "isd"
    )
    points = ground(rng, 3000)
    k, within, across = places(points, overlap=overlap)
    height = 16 - overlap
    within = height - within if flipped else within
    expected = within + height * (29 - k if reversed_ else k)
    line, sample = camera.ground_to_image(points)
    np.testing.assert_allclose(line, expected, atol=1e-6)
    np.testing.assert_allclose(sample, across, atol=1e-6)
    np.testing.assert_allclose(camera.ephemeris_time(line), 998.5 + 0.1 * k, atol=1e-9)
    assert camera.lines == 30 * height


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("reversed_", [False, True])
def test_round_trip_is_exact(rng, flipped, reversed_):
    """Every pixel's place is seen by the framelet whose middle is nearest: its own over the middle twelve lines."""
    camera = camera_from_document(isd(framelets_flipped=flipped, framelet_order_reversed=reversed_), "isd")
    framelet = rng.integers(0, 30, 4000)
    for height in (-800.0, 0.0, 1200.0):
        within = rng.uniform(1.7, 12.3, 4000)
        line, sample = framelet * 14 + within, rng.uniform(0, 16, 4000)
        points = camera.image_to_ground(line, sample, height)
        np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 1e6 + height, atol=1e-6)
        back = camera.ground_to_image(points)
        np.testing.assert_allclose(back[0], line, atol=1e-6)
        np.testing.assert_allclose(back[1], sample, atol=1e-6)
        # and at its edges, which two framelets see, the other one's pixel shows the same place
        line = framelet * 14 + rng.uniform(0.0, 14.0, 4000)
        points = camera.image_to_ground(line, sample, height)
        again = camera.ground_to_image(points)
        np.testing.assert_allclose(camera.image_to_ground(*again, height), points, atol=1e-4)
        assert np.all(np.abs(again[0] % 14 - 7) <= np.abs(line % 14 - 7) + 1e-6)


def test_places_between_and_beside_framelets(rng):
    """Framelets of ten lines that move by twelve: what lies between two was never seen."""
    camera = camera_from_document(isd(height=10, overlap=0), "isd")
    points = ground(rng, 4000, angles=(0.0012, 28 * 0.0012))
    _, within, _ = places(points, height=10, overlap=0)
    line, _ = camera.ground_to_image(points)
    gap = np.maximum(-within, within - 10)
    assert np.isnan(line[gap > 0.501]).all() and np.isfinite(line[gap < 0.499]).all()
    assert (gap > 0.501).sum() > 200
    before, after = (
        camera.ground_to_image(ground(rng, 1, angles=(-0.004, -0.004))),
        camera.ground_to_image(ground(rng, 1, angles=(0.04, 0.04))),
    )
    assert before[0][0] < 0 and after[0][0] > camera.lines
    assert np.isnan(camera.ground_to_image([[-1e6, 0.0, 0.0]])[0])  # the far side of the body


def test_pieces_hold_their_own_lines(rng):
    camera = camera_from_document(isd(framelets_flipped=True), "isd")
    line = rng.uniform(0.6, camera.lines - 0.6, 500)
    line = line[np.abs(line % 14 - 7) < 6.4]
    sample = rng.uniform(0, 16, line.size)
    points = camera.image_to_ground(line, sample)
    found = camera.ground_to_framelet(points, camera.framelet(line))
    np.testing.assert_allclose(found, [line, sample], atol=1e-6)
    following = camera.ground_to_framelet(points, np.minimum(camera.framelet(line) + 5, 29))
    assert np.all((following[0] % 14 >= 0.5 - 1e-9) & (following[0] % 14 <= 13.5 + 1e-9))


def test_summing_and_starting_pixels_move_the_image(rng):
    """A detector read from line 8 and sample 4 on, two by two pixels in one: half as many image pixels."""
    camera = camera_from_document(
        isd(
            height=16, overlap=0, detector_line_summing=2, detector_sample_summing=2, image_lines=30 * 8, image_samples=8,
            starting_detector_line=8, starting_detector_sample=4, detector_center={"line": 16.0, "sample": 12.0},
        ),
        "isd",
    )  # fmt: skip
    points = ground(rng, 500)
    k, within, across = places(points, overlap=0)
    line, sample = camera.ground_to_image(points)
    np.testing.assert_allclose(line, k * 8 + within / 2, atol=1e-6)
    np.testing.assert_allclose(sample, across / 2, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"framelet_height": 13}, InputError, "'image_lines' to be whole framelets .* = 13 lines, found 480"),
        ({"framelet_height": 0}, InputError, "whole number of pixels, 1 .. .* in 'framelet_height'"),
        ({"num_lines_overlap": 3}, InputError, "even number of lines"),
        ({"num_lines_overlap": 16}, InputError, "less than the framelet's 16"),
        ({"interframe_delay": 0.0}, InputError, "'interframe_delay' above 0 s"),
        ({"interframe_delay": 0.3}, InputError, "to cover the image's times"),
        ({"framelets_flipped": "no"}, InputError, "true or false in 'framelets_flipped', found 'no'"),
    ],
)
def test_bad_isds_are_refused_in_one_line(change, error, message):
    with pytest.raises(error, match=message) as caught:
        camera_from_document(isd(**change), "wac.json")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "key",
    ["framelet_height", "interframe_delay", "exposure_duration", "framelets_flipped", "framelet_order_reversed", "starting_ephemeris_time"],
)  # fmt: skip
def test_missing_keys_are_named(key):
    document = isd()
    del document[key]
    with pytest.raises(InputError, match=f"wac.json: expected the key '{key}'"):
        camera_from_document(document, "wac.json")


def test_a_camera_that_stands_still_is_refused():
    document = isd(rate=1e-12)
    with pytest.raises(GeometryError, match="expected a camera that moves over the ground"):
        camera_from_document(document, "wac.json")
    assert "push-frame" in {c.kind for c in cameras()}


# --- from a raw image to pairs --------------------------------------------------------------------------------------


def over_the_scene(**changes):
    """An ISD of a camera 10 km above the small scene's middle, 20 m a pixel, framelets of 14 lines that move by 11."""
    rate = 220.0 / small_scene.RADIUS / STEP
    framelets = 36
    up = unit_vectors(small_scene.LON, small_scene.LAT)
    south = np.cross(np.cross([0, 0, 1.0], up), up)
    middle = (framelets - 1) / 2 * rate * STEP
    # the orbit's axes at the middle: (cos, 0, -sin) is up and (-sin, 0, -cos) is ahead, which shall be south
    radial, ahead = (
        np.array([math.cos(middle), 0, -math.sin(middle)]),
        np.array([-math.sin(middle), 0, -math.cos(middle)]),
    )
    south /= np.linalg.norm(south)
    matrix = np.stack([up, south, np.cross(up, south)], axis=1) @ np.stack([radial, ahead, np.cross(radial, ahead)])
    w = math.sqrt(1 + np.trace(matrix)) / 2
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / (4 * w)
    sun = matrix.T @ unit_vectors(*small_scene.SUN) * AU / 1e3
    return isd(
        radius=small_scene.RADIUS,
        orbit=small_scene.RADIUS + 10e3,
        rate=rate,
        framelets=framelets,
        samples=360,
        body=[w, *axis],
        sun=sun.tolist(),
        **changes,
    )


@pytest.mark.parametrize(
    ("flipped", "reversed_"),
    [(True, False), *(pytest.param(*p, marks=pytest.mark.slow) for p in ((False, True), (False, False), (True, True)))],
)
def test_a_raw_push_frame_image_reaches_the_ground_it_shows(small_files, tmp_path, flipped, reversed_):
    document = over_the_scene(framelets_flipped=flipped, framelet_order_reversed=reversed_)
    camera = camera_from_document(document, "isd")
    (tmp_path / "wac.json").write_text(json.dumps(document))
    write_image(tmp_path / "raw.tif", photograph(camera))
    with (tmp_path / "images.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([["image_id", "path", "units", "camera"], ["WAC", "raw.tif", "iof", "wac.json"]])
    summary, path = run_all(small_files.dem, tmp_path / "images.csv", tmp_path)
    assert summary.valid_share > 0.99
    assert residual(path) < 3e-4
    assert residual(path) < 0.3 * residual(path, 0.25 * small_scene.GSD)
    with h5py.File(path) as file:
        line = file["detector_line"][...] + 0.5
        assert (line % 14).min() > 1 and (line % 14).max() < 13  # the middle of a framelet, of the two that overlap
        assert np.ptp(line) > 14 * 20
        np.testing.assert_allclose(read(file["phase_deg"], ...), 45, atol=22)
