"""From a raw camera image and its camera model to pairs: what a user does who has nothing map-projected."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import small_scene
from camera_rays import looking_at
from raw_frames import ALTITUDE, overhead_camera, photograph, residual, run_all, write_frame
from small_scene import LAT, LON, RADIUS

from schemas.errors import GeometryError, LunargrError
from schemas.packing import read
from stages import ingest
from stages.physics.bodies.ephemeris import subsolar_point, utc_to_et
from stages.physics.bodies.spheres import find_body
from stages.physics.cameras import open_camera
from stages.physics.images.labels import label_time, product_time
from stages.physics.images.table import read_frames
from stages.physics.maps.grid import unit_vectors


@pytest.fixture(scope="module")
def raw():
    return photograph(overhead_camera())


@pytest.fixture(scope="module")
def pairs(small_files, raw, tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    images = write_frame(folder, overhead_camera(), raw)
    return run_all(small_files.dem, images, folder)


def test_a_raw_image_reaches_the_ground_it_shows(pairs):
    summary, path = pairs
    assert summary.valid_share > 0.99
    assert residual(path) < 0.3 * residual(path, 0.25 * small_scene.GSD)  # a quarter pixel elsewhere fits much worse
    assert residual(path) < 3e-4


def test_spacecraft_and_detector_come_from_the_camera_model(pairs):
    _, path = pairs
    view = overhead_camera()
    with h5py.File(path) as file:
        distance = np.linalg.norm(file["camera_position_enu"][...], axis=1)
        assert np.all(np.abs(distance - ALTITUDE) < 1e3)
        line, sample_ = file["detector_line"][...], file["detector_sample"][...]
        assert np.nanmin(line) > -1 and np.nanmax(line) < view.lines
        assert np.nanmin(sample_) > -1 and np.nanmax(sample_) < view.samples
        k = 0
        middle = file["elevation"].shape[1] // 2
        radius = RADIUS + float(read(file["elevation"], k)[middle - 1 : middle + 1, middle - 1 : middle + 1].mean())
        place = unit_vectors(file["longitude_deg"][k], file["latitude_deg"][k]) * radius
        expected = view.ground_to_image(place)
        found = [v[k, middle - 1 : middle + 1, middle - 1 : middle + 1].mean() + 0.5 for v in (line, sample_)]
        np.testing.assert_allclose(found, expected, atol=0.02)
        # vertical view over gentle slopes; the Sun stands 45 deg from the vertical
        assert np.nanmax(read(file["emission_deg"], ...)) < 30
        np.testing.assert_allclose(read(file["phase_deg"], ...), 45, atol=3)


# --- what the table leaves out --------------------------------------------------------------------------------------


def test_a_time_alone_is_enough_for_the_sun(raw, tmp_path):
    empty = {"subsolar_longitude_deg": "", "subsolar_latitude_deg": "", "solar_distance_au": ""}
    frame = read_frames(write_frame(tmp_path, overhead_camera(), raw, start_time="2010-11-09T13:06:40", **empty))[0]
    expected = subsolar_point("2010-11-09T13:06:40")
    found = frame.subsolar_longitude_deg, frame.subsolar_latitude_deg, frame.solar_distance_au
    assert found == pytest.approx(tuple(expected))
    assert frame.spacecraft_altitude_m == pytest.approx(ALTITUDE)
    assert frame.spacecraft_longitude_deg == pytest.approx(LON)


def test_a_nac_product_id_is_a_time(raw, tmp_path):
    empty = {"subsolar_longitude_deg": "", "subsolar_latitude_deg": "", "solar_distance_au": ""}
    frame = read_frames(write_frame(tmp_path, overhead_camera(), raw, image_id="M143947267LE", **empty))[0]
    expected = subsolar_point("2010-11-09T13:06:40.356")
    assert frame.subsolar_longitude_deg == pytest.approx(expected.longitude_deg, abs=1e-3)


@pytest.mark.parametrize(
    ("product", "start"),
    [  # start times of the products' own labels
        ("M143947267LE", "2010-11-09T13:06:40.356"),
        ("M103595705LE", "2009-07-30T12:20:38.18"),
        ("M1181493219CE", "2015-03-20T12:19:12.019"),
    ],
)
def test_product_ids_count_the_clock(product, start):
    assert abs(utc_to_et(product_time(product)) - utc_to_et(start)) < 1.0
    assert product_time("AS15-M-0295") is None


@pytest.mark.parametrize("name", ["formats/M143947267L.cal.echo.crop.cub", "apollo15_cubes/AS15-M-0297_crop.cub"])
def test_a_cube_is_its_own_camera(shared, tmp_path, name):
    """Line scanner and framing camera: time, Sun and spacecraft, without a column for the camera."""
    cube, table = shared / "data" / name, tmp_path / "images.csv"
    table.write_text(f"image_id,path,units\nA,{cube},dn\n")
    (frame,) = read_frames(table)
    assert frame.camera == frame.path == cube
    view = open_camera(cube)
    time, sun = float(view.ephemeris_time(0.0)), view.sun_position(view.lines / 2)
    assert utc_to_et(frame.start_time) == pytest.approx(time, abs=1e-3)
    np.testing.assert_allclose(frame.sun_position(), sun, rtol=1e-9)
    assert frame.subsolar_longitude_deg == pytest.approx(subsolar_point(frame.start_time).longitude_deg, abs=0.01)
    np.testing.assert_allclose(frame.camera_position(RADIUS), view.position(view.lines / 2), atol=1e-3)


def test_the_body_must_be_the_cameras(raw, tmp_path):
    with pytest.raises(GeometryError, match=r"expected a camera at a body of 3.3895e\+06 m radius, found 1.7374e\+06"):
        read_frames(write_frame(tmp_path, overhead_camera(), raw), find_body("Mars"))


def test_labels_hold_times(tmp_path, shared):
    (tmp_path / "a.img").write_bytes(b"PDS_VERSION_ID = PDS3\r\nSTART_TIME = 2010-11-09T13:06:40.356\r\nEND\r\n")
    assert label_time(tmp_path / "a.img") == "2010-11-09T13:06:40.356"
    (tmp_path / "b.tif").write_bytes(b"II*\0")
    (tmp_path / "b.lbl").write_text(
        "PDS_VERSION_ID = PDS3\nOBJECT = IMAGE\n  LINES = 3 /* rows */\nEND_OBJECT = IMAGE\nSTART_TIME = 2009-211T12:20:38\nEND\n"
    )
    assert label_time(tmp_path / "b.tif") == "2009-211T12:20:38"
    (tmp_path / "c.xml").write_text(
        '<Product xmlns="http://pds.nasa.gov/pds4/pds/v1"><Time_Coordinates><start_date_time>2020-01-02T03:04:05Z'
        "</start_date_time></Time_Coordinates></Product>"
    )
    assert label_time(tmp_path / "c.img") == "2020-01-02T03:04:05Z"
    assert label_time(shared / "data/formats/M143947267L.cal.echo.crop.cub") == "2010-11-09T13:06:40.356"


# --- bad input ------------------------------------------------------------------------------------------------------


SPACECRAFT = {"spacecraft_longitude_deg": LON, "spacecraft_latitude_deg": LAT, "spacecraft_altitude_m": ALTITUDE}


def test_bad_camera_images_get_one_clear_line(small_files, raw, tmp_path):
    images = write_frame(tmp_path, overhead_camera(), raw[:-1])
    cases = {"expected 380 lines x 400 samples as its camera model has, found 379 x 400": images}
    away = looking_at(overhead_camera().centre, overhead_camera().centre * 2, 0.05, (400, 380))
    (tmp_path / "b").mkdir()
    cases["does not touch the DEM"] = write_frame(tmp_path / "b", away, raw, **SPACECRAFT)
    (tmp_path / "c").mkdir()
    cases["no such file; expected a camera model"] = write_frame(
        tmp_path / "c", overhead_camera(), raw, camera="none.json"
    )
    for message, table in cases.items():
        with pytest.raises(LunargrError, match=message) as caught:
            ingest.run(small_files.dem, table, tmp_path / "scene.h5", ingest.Config(gsd=20, crop=32))
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "scene.h5").exists()
