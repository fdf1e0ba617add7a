"""`lunargr render` through cameras: the same ground as the map shows, frame and line-scan cameras, trajectories."""

from __future__ import annotations

import json
import math

import h5py
import numpy as np
import pytest
from relief import RADIUS, hills, metric_grid
from render_scene import LAT, LON, SUN, lunargr_render, write_dem
from scipy.spatial.transform import Rotation

from stages import render
from stages.physics.bodies.spheres import Body
from stages.physics.cameras import camera_from_document, read_document
from stages.physics.maps.grid import read_grid, unit_vectors
from stages.physics.terrain.surface import open_surface
from stages.render.pictures import read_exr
from stages.render.ray_points import hit_points
from stages.render.raycast import HIT, build_height_field, cast


def test_a_camera_over_the_map_sees_what_the_map_says(hilly_map, tmp_path):
    """A pinhole view's pixels, looked up by their own longitude and latitude, are those of the ortho view from its place."""
    path, grid, *_ = hilly_map
    place = (LON + 0.002, LAT - 0.003, 4000.0)
    sun = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 35.0}
    render.run(path, tmp_path / "map.exr", render.Config(position=place, **sun))
    config = render.Config(view="pinhole", position=place, look_at=(LON, LAT), fov_deg=8.0, size_px=(90, 60), **sun)
    render.run(path, tmp_path / "view.exr", config)
    ortho, view = read_exr(tmp_path / "map.exr"), read_exr(tmp_path / "view.exr")
    row, col = grid.rowcol_of_lonlat(view["longitude_deg"].astype(float), view["latitude_deg"].astype(float))
    r, c = np.rint(row).astype(int), np.rint(col).astype(int)
    for name, tolerance in (("image", 2e-3), ("emission_deg", 4.0), ("phase_deg", 0.1), ("depth", 5.0)):
        miss = np.abs(view[name] - ortho[name][r, c])
        assert np.nanpercentile(miss, 95) < tolerance, name
    assert np.corrcoef(view["image"].ravel(), np.nan_to_num(ortho["image"][r, c]).ravel())[0, 1] > 0.97


def test_the_look_at_place_is_in_the_middle_and_a_camera_file_is_the_same_camera(hilly_map, tmp_path):
    path, *_ = hilly_map
    place, target = (LON + 0.01, LAT + 0.004, 2500.0), (LON + 0.002, LAT - 0.001)
    sun = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 35.0}
    config = render.Config(view="pinhole", position=place, look_at=target, fov_deg=14.0, size_px=(61, 41), **sun)
    render.run(path, tmp_path / "a.exr", config)
    a = read_exr(tmp_path / "a.exr")
    assert a["longitude_deg"][20, 30] == pytest.approx(target[0], abs=2e-4)
    assert a["latitude_deg"][20, 30] == pytest.approx(target[1], abs=2e-4)
    # an independent route to the same camera: axes by hand, given as a JSON document and as a quaternion
    position, rotation = camera_by_hand(path, place, target)
    focal = 61 / 2 / math.tan(math.radians(7.0))
    document = {
        "type": "pinhole", "focal_px": focal, "principal_point_px": [30.5, 20.5], "size_px": [61, 41],
        "position_mcmf": position.tolist(), "rotation_camera_to_mcmf": rotation.tolist(),
    }  # fmt: skip
    (tmp_path / "camera.json").write_text(json.dumps(document))
    render.run(path, tmp_path / "b.exr", render.Config(view="pinhole", camera=str(tmp_path / "camera.json"), **sun))
    b = read_exr(tmp_path / "b.exr")
    np.testing.assert_allclose(b["depth"], a["depth"], atol=0.5)
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    config = render.Config(
        view="pinhole", position=place, quaternion=(w, x, y, z), fov_deg=14.0, size_px=(61, 41), **sun
    )
    render.run(path, tmp_path / "c.exr", config)
    np.testing.assert_allclose(read_exr(tmp_path / "c.exr")["depth"], a["depth"], atol=0.5)


def camera_by_hand(path, place, target):
    """Position and camera axes (right, down, forward), worked out without the renderer."""
    with h5py.File(path) as file:
        grid = read_grid(file, path)
        row, col = (round(float(v)) for v in grid.rowcol_of_lonlat(*target))
        height = float(file["elevation"][row, col])
    position = unit_vectors(*place[:2]) * (RADIUS + place[2])
    forward = unit_vectors(*target) * (RADIUS + height) - position
    forward /= np.linalg.norm(forward)
    away = position / np.linalg.norm(position)
    down = (away @ forward) * forward - away
    down /= np.linalg.norm(down)
    return position, np.stack([np.cross(down, forward), down, forward], axis=1)


def test_nadir_views_have_north_up_and_east_right(hilly_map, tmp_path):
    path, *_ = hilly_map
    config = render.Config(
        view="pinhole",
        position=(LON, LAT, 5000.0),
        fov_deg=6.0,
        size_px=(33, 33),
        sun_azimuth_deg=90.0,
        sun_elevation_deg=40.0,
    )
    render.run(path, tmp_path / "v.exr", config)
    view = read_exr(tmp_path / "v.exr")
    assert (np.diff(np.nanmean(view["latitude_deg"], axis=1)) < 0).all()
    assert (np.diff(np.nanmean(view["longitude_deg"], axis=0)) > 0).all()


def test_a_view_that_is_finer_than_the_map_says_so(hilly_map, tmp_path, monkeypatch, capsys):
    """A post of 5 m spans as many pixels as the similar triangles say."""
    path, _, elevation, _ = hilly_map
    height = float(elevation[80, 100])
    for altitude, says in ((400.0, True), (40000.0, False)):
        view = (
            "--position",
            f"{LON},{LAT},{height + altitude}",
            "--fov",
            "10",
            "--size",
            "70,50",
            "-o",
            tmp_path / "v.exr",
        )
        code, told = lunargr_render(monkeypatch, capsys, path, *view, *SUN, "--overwrite")
        expected = 5.0 / (altitude * 2 * math.tan(math.radians(5)) / 70)
        assert code == 0 and (f"v: {expected:.0f} image pixels to a DEM pixel" in told) == says, told


def test_the_sky_is_black_and_ground_off_the_map_unknown(hilly_map, tmp_path):
    path, _, elevation, _ = hilly_map
    height = float(elevation.max()) + 30.0
    config = render.Config(
        view="pinhole", position=(LON, LAT - 0.01, height), look_at=(LON, LAT + 0.1, height), fov_deg=60.0, size_px=(40, 40),
        sun_azimuth_deg=100.0, sun_elevation_deg=35.0,
    )  # fmt: skip
    render.run(path, tmp_path / "v.exr", config)
    view = read_exr(tmp_path / "v.exr")
    assert (view["image"][:10] == 0).all()
    assert np.isnan(view["depth"][:10]).all()
    assert np.isfinite(view["depth"][-5:]).any()
    assert np.isnan(view["image"]).any()  # between the map's edge and the horizon


def test_a_trajectory_can_be_cut_into_shards_and_resumed(hilly_map, tmp_path, monkeypatch, capsys):
    path, *_ = hilly_map
    table = tmp_path / "views.csv"
    table.write_text(
        "view_id,longitude_deg,latitude_deg,altitude_m,look_longitude_deg,look_latitude_deg,sun_azimuth_deg,sun_elevation_deg\n"
        f"a,{LON},{LAT},4000,,,,\n"
        f"b,{LON},{LAT - 0.02},2000,{LON},{LAT},,\n"
        f"c,{LON},{LAT},3000,{LON},{LAT},280,20\n"
    )
    folder = tmp_path / "views"
    common = [path, "--trajectory", table, *SUN, "--fov", "10", "--size", "32,24", "-o", folder, "--quiet"]
    assert lunargr_render(monkeypatch, capsys, *common, "--shard", "1/2") == (0, "")
    assert sorted(p.name for p in folder.iterdir()) == ["a.exr", "a.png", "c.exr", "c.png"]
    before = (folder / "a.exr").stat().st_mtime_ns
    assert lunargr_render(monkeypatch, capsys, *common, "--resume") == (0, "")
    assert sorted(p.stem for p in folder.glob("*.exr")) == ["a", "b", "c"]
    assert (folder / "a.exr").stat().st_mtime_ns == before
    code, error = lunargr_render(monkeypatch, capsys, *common)
    assert code == 3 and "--overwrite" in error
    a, c = read_exr(folder / "a.exr"), read_exr(folder / "c.exr")
    middle = (12, 16)
    assert abs(a["incidence_deg"][middle] - c["incidence_deg"][middle]) > 3  # the row's own Sun


def test_a_line_scan_camera_sees_ground_that_its_own_model_projects_back(shared, tmp_path):
    """LROC NAC: rays onto hills, and the hits through the camera's ground-to-image, which knows nothing of rays."""
    path = shared / "oracles" / "ale_lrolroc_M103595705LE.isd.json"
    camera = camera_from_document(read_document(path), str(path))
    centre = camera.image_to_ground(camera.lines / 2, camera.samples / 2)
    lon, lat = (
        math.degrees(math.atan2(centre[1], centre[0])),
        math.degrees(math.asin(centre[2] / np.linalg.norm(centre))),
    )
    size, gsd = 1000, 10.0
    grid = metric_grid(size, size, gsd, lon, lat)
    dem = write_dem(tmp_path / "dem.tif", grid, hills(np.random.default_rng(3), size, gsd))
    with open_surface(dem, "lambert", {}, Body("moon", RADIUS)) as surface:
        field = build_height_field(surface.elevation[0:size, 0:size], grid)
        line, sample = (v.ravel() for v in np.meshgrid(np.linspace(1, 399, 12), np.linspace(1200, 3800, 17)))
        origins, directions = camera.rays(line, sample)
        hits = cast(field, origins, directions)
        assert (hits.status == HIT).mean() > 0.9
        back = camera.ground_to_image(hit_points(hits, origins, directions))
        met = hits.status == HIT
        np.testing.assert_allclose(back[0][met], line[met], atol=1e-3)
        np.testing.assert_allclose(back[1][met], sample[met], atol=1e-3)
    # the whole command, with the Sun that the camera model knows
    config = render.Config(view="pinhole", camera=str(path), samples=1, shadows=False, model="lambert")
    small = tmp_path / "strip.exr"
    summary = render.run(tmp_path / "dem.tif", small, config)
    assert summary.size_px == (5064, 400)
    view = read_exr(small)
    sun = camera.sun_position(np.array([200.0]))[0] - centre
    incidence = math.degrees(math.acos(sun @ centre / np.linalg.norm(sun) / np.linalg.norm(centre)))
    assert np.nanmean(view["incidence_deg"]) == pytest.approx(incidence, abs=5.0)
