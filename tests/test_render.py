"""`lunargr render`: closed forms on known ground, georeference to the pixel, files, trajectories and bad input."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys

import h5py
import numpy as np
import OpenImageIO as oiio
import pytest
import rasterio
from rasterio.transform import Affine
from scipy.spatial.transform import Rotation
from test_raycast import hills

from lunargr_cli import main as cli
from schemas import DIAGNOSIS, SVBRDF, ArtefactWriter
from stages import render
from stages.physics import light
from stages.physics.bodies import Body
from stages.physics.cameras import camera_from_document, read_document
from stages.physics.grid import Grid, local_metric_crs, read_grid, unit_vectors
from stages.physics.hits import hit_points
from stages.physics.photometry import evaluate
from stages.physics.pictures import read_exr
from stages.physics.raycast import HIT, build_height_field, cast
from stages.physics.surface import open_surface
from stages.render import maps

RADIUS = 1737400.0
LON, LAT = -42.0, 17.0
SUN = ("--sun-azimuth", "100", "--sun-elevation", "35")


def make_grid(height: int, width: int, gsd: float) -> Grid:
    crs = local_metric_crs(LON, LAT, RADIUS)
    return Grid(crs.to_wkt(), Affine(gsd, 0, -width * gsd / 2, 0, -gsd, height * gsd / 2), height, width, RADIUS)


def write_svbrdf(path, grid: Grid, elevation: np.ndarray, coefficients: np.ndarray, model: str = "M2"):
    names = {"M2": ["a", "b", "c"], "lambert": ["albedo"]}[model]
    attributes = {"gsd_m": grid.gsd, "body_radius_m": RADIUS, "model": model, "quantity": "I/F"}
    sizes = {"coefficient": len(names), "y": grid.height, "x": grid.width}
    with ArtefactWriter(path, SVBRDF, sizes, attributes=attributes) as writer:
        x, y = grid.xy(np.arange(grid.height)[:, None], np.arange(grid.width))
        writer.write("x", x[0])
        writer.write("y", y[:, 0])
        writer.write("coefficients", coefficients.astype(np.float32))
        writer.write("coefficient_name", names)
        writer.write("elevation", elevation.astype(np.float32))
        writer.write("valid", np.isfinite(coefficients).all(axis=0).astype(np.uint8))
        writer.write_crs(grid.crs_wkt, grid.transform)
    return path


def write_dem(path, grid: Grid, elevation: np.ndarray, **changes):
    profile = {
        "driver": "GTiff", "height": grid.height, "width": grid.width, "count": 1, "dtype": "float32",
        "crs": grid.crs, "transform": grid.transform, "nodata": -9999.0, **changes,
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as target:
        target.write(np.nan_to_num(elevation, nan=-9999.0).astype(np.float32), 1)
    return path


def smooth_maps(rng, shape, count=3):
    smooth = np.stack([hills(rng, max(shape), 1.0)[: shape[0], : shape[1]] for _ in range(count)])
    return 0.05 + 0.01 * smooth / np.abs(smooth).max()


@pytest.fixture
def scene(rng, tmp_path):
    """A hilly 160 x 200 map with varying M2 coefficients and a hole."""
    grid = make_grid(160, 200, 5.0)
    elevation = hills(rng, 200, 5.0)[:160]
    coefficients = smooth_maps(rng, (160, 200))
    coefficients[:, 20:40, 60:90] = np.nan
    return write_svbrdf(tmp_path / "svbrdf.h5", grid, elevation, coefficients), grid, elevation, coefficients


def lunargr(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    """Exit code and standard error of the command line."""
    monkeypatch.setattr(os, "_exit", sys.exit)  # the command line leaves Python at once after an error
    monkeypatch.setattr(sys, "argv", ["lunargr", "render", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0), capsys.readouterr().err


def test_a_level_map_has_the_angles_of_the_sphere(tmp_path):
    """On bare ground incidence follows from the sub-solar point alone, and turns by 1 deg per 30 km."""
    grid = make_grid(300, 400, 300.0)  # 90 x 120 km
    path = write_svbrdf(tmp_path / "s.h5", grid, np.zeros((300, 400)), np.full((1, 300, 400), 0.2), "lambert")
    config = render.Config(subsolar_longitude_deg=-80.0, subsolar_latitude_deg=-5.0)
    render.run(path, tmp_path / "o.exr", config)
    found = read_exr(tmp_path / "o.exr")
    rows, cols = np.indices((300, 400))
    lon, lat = grid.lonlat(rows.ravel(), cols.ravel())
    up = unit_vectors(lon, lat)
    sun = unit_vectors(-80.0, -5.0) * 149597870700.0 - up * RADIUS
    sun /= np.linalg.norm(sun, axis=1, keepdims=True)
    incidence = np.degrees(np.arccos((up * sun).sum(1))).reshape(300, 400)
    np.testing.assert_allclose(found["incidence_deg"], incidence, atol=2e-3)
    np.testing.assert_allclose(found["phase_deg"], incidence, atol=2e-3)
    assert np.ptp(incidence) > 3.0
    np.testing.assert_allclose(found["image"], 0.2 * np.cos(np.radians(incidence)), rtol=1e-4)
    np.testing.assert_allclose(found["emission_deg"], 0.0, atol=0.05)  # acos near 1 in float32
    np.testing.assert_allclose(found["longitude_deg"], lon.reshape(300, 400), atol=1e-4)
    np.testing.assert_allclose(found["latitude_deg"], lat.reshape(300, 400), atol=1e-4)
    assert (found["shadow"] == 0).all()


def test_sun_angles_hold_at_the_middle_clockwise_from_true_north(tmp_path):
    """A polar stereographic map's rows are not parallels: azimuth counts from true north, not from the rows."""
    wkt = rasterio.crs.CRS.from_proj4(f"+proj=stere +lat_0=-90 +lat_ts=-90 +lon_0=0 +R={RADIUS} +units=m").to_wkt()
    grid = Grid(wkt, Affine(20.0, 0, 60e3, 0, -20.0, 62e3), 101, 101, RADIUS)
    # a plane that falls towards the north of the middle pixel
    lon, lat = (float(v) for v in grid.lonlat(50, 50))
    axes = grid.local_frames(50, 50).axes[0]
    north = np.cross(unit_vectors(lon, lat), np.cross([0, 0, 1.0], unit_vectors(lon, lat)))
    along = axes @ (north / np.linalg.norm(north))  # grid east, grid north of true north
    r, c = np.indices((101, 101)) - 50.0
    elevation = -0.2 * 20.0 * (c * along[0] - r * along[1])
    path = write_dem(tmp_path / "d.tif", grid, elevation)
    config = render.Config(sun_azimuth_deg=0.0, sun_elevation_deg=40.0, shadows=False)
    render.run(path, tmp_path / "o.exr", config)
    tilt = math.degrees(math.atan(0.2))
    assert read_exr(tmp_path / "o.exr")["incidence_deg"][50, 50] == pytest.approx(50.0 - tilt, abs=0.05)


def test_ortho_image_is_the_model_at_the_backplanes_angles_and_the_map_to_the_pixel(scene, tmp_path):
    path, grid, _, coefficients = scene
    config = render.Config(sun_azimuth_deg=100.0, sun_elevation_deg=35.0)
    summary = render.run(path, tmp_path / "o.exr", config)
    exr = read_exr(tmp_path / "o.exr")
    angles = (np.radians(exr[f"{k}_deg"]) for k in ("incidence", "emission", "phase"))
    expected = evaluate("M2", dict(zip("abc", coefficients, strict=True)), *angles)
    lit = (exr["shadow"] == 0) & np.isfinite(coefficients[0])
    assert lit.mean() > 0.5
    np.testing.assert_allclose(exr["image"][lit], expected[lit], rtol=2e-4)
    assert (np.isnan(exr["image"]) == np.isnan(coefficients[0])).all()
    assert summary.known_share == pytest.approx(1 - 600 / 32000)
    with rasterio.open(tmp_path / "o.tif") as tif:
        assert tif.shape == (160, 200)
        assert tif.transform.almost_equals(grid.transform)
        assert tif.crs == grid.crs
        assert math.isnan(tif.nodata)
        assert tif.descriptions == ("image",)
        assert tif.tags()["MODEL"] == "M2"
        np.testing.assert_array_equal(tif.read(1), exr["image"])
    picture = oiio.ImageBuf(str(tmp_path / "o.png"))
    pixels = picture.get_pixels(oiio.UINT8)
    assert pixels.shape == (160, 200, 2)
    assert (pixels[20:40, 60:90] == 0).all()
    assert (pixels[:20, :, 1] == 255).all()
    assert 40 < np.median(pixels[..., 0]) < 240


def test_blocks_make_no_difference(scene, tmp_path, monkeypatch):
    path, *_ = scene
    config = render.Config(sun_azimuth_deg=100.0, sun_elevation_deg=20.0)
    render.run(path, tmp_path / "whole.exr", config)
    monkeypatch.setattr(maps, "BAND_ROWS", 33)
    monkeypatch.setattr(maps, "BAND_COLUMNS", 71)
    render.run(path, tmp_path / "blocks.exr", config)
    whole, blocks = read_exr(tmp_path / "whole.exr"), read_exr(tmp_path / "blocks.exr")
    for name in whole:
        np.testing.assert_allclose(
            blocks[name], whole[name], atol=2e-3 if name.endswith("_deg") else 1e-5, err_msg=name
        )


def test_horizons_in_blocks_agree_with_one_sweep(scene, tmp_path, monkeypatch):
    """Large maps take the horizon block by block; the shadows must be those of the whole map."""
    path, *_ = scene
    config = render.Config(sun_azimuth_deg=100.0, sun_elevation_deg=12.0)
    render.run(path, tmp_path / "whole.exr", config)
    monkeypatch.setattr(light, "WHOLE_PX", 0)
    monkeypatch.setattr(light, "BLOCK_PX", 64)
    render.run(path, tmp_path / "blocks.exr", config)
    whole, blocks = (read_exr(tmp_path / f"{n}.exr")["shadow"] for n in ("whole", "blocks"))
    assert 0.02 < (whole > 0.5).mean() < 0.6
    assert ((whole > 0.5) != (blocks > 0.5)).mean() < 0.004


def test_a_camera_over_the_map_sees_what_the_map_says(scene, tmp_path):
    """A pinhole view's pixels, looked up by their own longitude and latitude, are those of the ortho view from its place."""
    path, grid, *_ = scene
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


def test_the_look_at_place_is_in_the_middle_and_a_camera_file_is_the_same_camera(scene, tmp_path):
    path, *_ = scene
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


def test_nadir_views_have_north_up_and_east_right(scene, tmp_path):
    path, *_ = scene
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


def test_the_sky_is_black_and_ground_off_the_map_unknown(scene, tmp_path):
    path, _, elevation, _ = scene
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


def test_extensions_reach_both_kinds_of_view(scene, tmp_path):
    """A pedestal of known height is added in the sensor slot, by the ortho view and by the camera alike."""
    path, *_ = scene
    extension = json.dumps([{"effect": "dark_bias", "values": {"iof": 0.007}, "survey": {}}])
    attributes = {"report": "{}", "extension": extension}
    with ArtefactWriter(tmp_path / "diagnosis.h5", DIAGNOSIS, {"frame": 1}, attributes=attributes) as writer:
        writer.write("image_id", ["one"])
    sun = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 35.0}
    view = {"view": "pinhole", "position": (LON, LAT, 4000.0), "fov_deg": 8.0, "size_px": (48, 48)}
    for name, changes in (("map", {}), ("view", view)):
        base, more = tmp_path / f"{name}.exr", tmp_path / f"{name}_more.exr"
        render.run(path, base, render.Config(**sun, **changes))
        render.run(path, more, render.Config(**sun, **changes, extension=str(tmp_path / "diagnosis.h5")))
        difference = read_exr(more)["image"] - read_exr(base)["image"]
        known = np.isfinite(difference)
        assert known.mean() > 0.9
        assert np.median(difference[known]) == pytest.approx(0.007, abs=3e-4)


def test_a_dem_with_one_model_everywhere(rng, tmp_path, monkeypatch, capsys):
    grid = make_grid(64, 64, 10.0)
    elevation = hills(rng, 64, 10.0)
    elevation[5:9, 5:9] = np.nan
    dem = write_dem(tmp_path / "dem.tif", grid, elevation)
    code, error = lunargr(
        monkeypatch, capsys, "--dem", dem, "--model", "minnaert", "--parameters", "albedo=0.2", *SUN, "-o", tmp_path / "o.exr",
        "--json", tmp_path / "o.json", "--no-shadows", "--quiet",
    )  # fmt: skip
    assert (code, error) == (0, "")
    exr = read_exr(tmp_path / "o.exr")
    angles = (np.radians(exr[f"{k}_deg"]) for k in ("incidence", "emission", "phase"))
    expected = np.where(np.isnan(elevation), np.nan, evaluate("minnaert", {"albedo": 0.2}, *angles))
    np.testing.assert_allclose(exr["image"], expected, rtol=3e-4, atol=1e-6)
    assert np.isnan(exr["image"][5:9, 5:9]).all()
    assert np.isfinite(exr["image"]).sum() == 64 * 64 - 16
    told = json.loads((tmp_path / "o.json").read_text())["views"][0]
    assert told["mean_iof"] == pytest.approx(float(np.nanmean(exr["image"])), rel=1e-5)


def test_a_trajectory_can_be_cut_into_shards_and_resumed(scene, tmp_path, monkeypatch, capsys):
    path, *_ = scene
    table = tmp_path / "views.csv"
    table.write_text(
        "view_id,longitude_deg,latitude_deg,altitude_m,look_longitude_deg,look_latitude_deg,sun_azimuth_deg,sun_elevation_deg\n"
        f"a,{LON},{LAT},4000,,,,\n"
        f"b,{LON},{LAT - 0.02},2000,{LON},{LAT},,\n"
        f"c,{LON},{LAT},3000,{LON},{LAT},280,20\n"
    )
    folder = tmp_path / "views"
    common = [path, "--trajectory", table, *SUN, "--fov", "10", "--size", "32,24", "-o", folder, "--quiet"]
    assert lunargr(monkeypatch, capsys, *common, "--shard", "1/2") == (0, "")
    assert sorted(p.name for p in folder.iterdir()) == ["a.exr", "a.png", "c.exr", "c.png"]
    before = (folder / "a.exr").stat().st_mtime_ns
    assert lunargr(monkeypatch, capsys, *common, "--resume") == (0, "")
    assert sorted(p.stem for p in folder.glob("*.exr")) == ["a", "b", "c"]
    assert (folder / "a.exr").stat().st_mtime_ns == before
    code, error = lunargr(monkeypatch, capsys, *common)
    assert code == 3 and "--overwrite" in error
    a, c = read_exr(folder / "a.exr"), read_exr(folder / "c.exr")
    middle = (12, 16)
    assert abs(a["incidence_deg"][middle] - c["incidence_deg"][middle]) > 3  # the row's own Sun


BAD = [
    ((*SUN[:2], "--sun-elevation", "-5"), "below the horizon"),
    (("--subsolar-longitude", "138", "--subsolar-latitude", "-17"), "below the horizon everywhere"),
    ((), "--sun-azimuth"),
    ((*SUN, "--time", "2010-11-09"), "more than one"),
    ((*SUN[:2],), "--sun-elevation"),
    ((*SUN, "--view", "pinhole"), "--position"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},-500"), "under the ground"),
    ((*SUN, "--view", "pinhole", "--position", "10,10,5000"), "misses svbrdf.h5"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},5000", "--look-at", "100,0"), "does not see|misses"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},5000", "--quaternion", "1,1,0,0"), "unit length"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT}"), "3 numbers"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},5000", "--fov", "200"), "--fov"),
    ((*SUN, "--size", "0,10", "--view", "pinhole", "--position", f"{LON},{LAT},5000"), "--size"),
    ((*SUN, "--view", "fisheye"), "ortho, pinhole"),
    ((*SUN, "--model", "hapke"), "--dem"),
    ((*SUN, "-o", "out.jpg"), ".exr, .tif or .png"),
    ((*SUN, "--camera", "missing.json"), "no such file"),
    ((*SUN, "--trajectory", "missing.csv", "-o", "views"), "no such file"),
    ((*SUN, "--samples", "99"), "--samples"),
    ((*SUN, "--shard", "1/2"), "--trajectory"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_bad_input_is_one_clear_line(scene, tmp_path, monkeypatch, capsys, arguments, message):
    path, *_ = scene
    monkeypatch.chdir(tmp_path)
    output = () if "-o" in arguments else ("-o", "out.exr")
    code, error = lunargr(monkeypatch, capsys, path, *arguments, *output, "--quiet")
    assert code == 3
    assert error.count("\n") == 1 and re.search(message, error), error
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["svbrdf.h5"]


def test_files_that_cannot_be_rendered(rng, scene, tmp_path, monkeypatch, capsys):
    path, grid, elevation, _ = scene
    degrees = write_dem(
        tmp_path / "degrees.tif",
        grid,
        elevation,
        crs="+proj=longlat +R=1737400",
        transform=Affine(0.01, 0, 10, 0, -0.01, 20),
    )
    empty = write_dem(tmp_path / "empty.tif", grid, np.full_like(elevation, np.nan))
    mars = write_dem(tmp_path / "mars.tif", grid, elevation, crs="+proj=stere +lat_0=10 +lon_0=20 +R=3389500")
    (tmp_path / "text.h5").write_text("not HDF5")
    out = ("-o", tmp_path / "o.exr", "--quiet")
    for arguments, message in (
        ((path, "--dem", degrees), "one of the two"),
        (("--dem", degrees), "lunargr ingest"),
        (("--dem", empty), "nodata"),
        (("--dem", mars), "--body"),
        (("--dem", tmp_path / "none.tif"), "no such file"),
        ((tmp_path / "text.h5",), "another kind of file"),
        (("--dem", path, "--model", "nonsense"), "choose one of"),
        (("--dem", path, "--parameters", "albedo"), "NAME=VALUE"),
        (("--dem", path, "--parameters", "colour=1"), "unknown parameter"),
    ):
        code, error = lunargr(monkeypatch, capsys, *arguments, *SUN, *out)
        assert code == 3 and message in error and error.count("\n") == 1, error
    assert lunargr(monkeypatch, capsys, path, *SUN, *out)[0] == 0
    code, error = lunargr(monkeypatch, capsys, path, *SUN, *out)
    assert code == 3 and "--overwrite" in error
    assert not [p.name for p in tmp_path.iterdir() if "partial" in p.name]


def test_a_line_scan_camera_sees_ground_that_its_own_model_projects_back(shared, tmp_path):
    """LROC NAC: rays onto hills, and the hits through the camera's ground-to-image, which knows nothing of rays."""
    path = shared / "oracles" / "ale_lrolroc_M103595705LE.isd.json"
    camera = camera_from_document(read_document(path), str(path))
    centre = camera.image_to_ground(camera.lines / 2, camera.samples / 2)
    lon, lat = (
        math.degrees(math.atan2(centre[1], centre[0])),
        math.degrees(math.asin(centre[2] / np.linalg.norm(centre))),
    )
    crs = local_metric_crs(lon, lat, RADIUS)
    size, gsd = 1000, 10.0
    grid = Grid(crs.to_wkt(), Affine(gsd, 0, -size * gsd / 2, 0, -gsd, size * gsd / 2), size, size, RADIUS)
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
    config = render.Config(view="pinhole", camera=str(path), samples=1, shadows=False)
    small = tmp_path / "strip.exr"
    summary = render.run(tmp_path / "dem.tif", small, config)
    assert summary.size_px == (5064, 400)
    view = read_exr(small)
    sun = camera.sun_position(np.array([200.0]))[0] - centre
    incidence = math.degrees(math.acos(sun @ centre / np.linalg.norm(sun) / np.linalg.norm(centre)))
    assert np.nanmean(view["incidence_deg"]) == pytest.approx(incidence, abs=5.0)


def test_an_interrupted_render_leaves_nothing(scene, tmp_path, monkeypatch):
    path, *_ = scene
    calls = []

    def stop(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(*arguments)

    original = maps.shade_block
    monkeypatch.setattr(maps, "shade_block", stop)
    monkeypatch.setattr(maps, "BAND_ROWS", 40)
    with pytest.raises(KeyboardInterrupt):
        render.run(path, tmp_path / "o.exr", render.Config(sun_azimuth_deg=1.0, sun_elevation_deg=40.0))
    assert [p.name for p in tmp_path.iterdir()] == ["svbrdf.h5"]


@pytest.mark.parametrize("suffix", ["exr", "tif"])
def test_a_file_that_cannot_grow_is_one_line_and_nothing_half_written(scene, tmp_path, suffix):
    """As on a full disk or over quota: the process may write no more than 60 kB into one file."""
    path, *_ = scene
    out = tmp_path / "out"
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000));"
        f"sys.argv = ['lunargr', 'render', {str(path)!r}, *{SUN!r}, '-o', {str(out / f'o.{suffix}')!r}, '-q'];"
        "from lunargr_cli.main import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    told = [line for line in done.stderr.splitlines() if line.startswith("lunargr")]
    assert done.returncode == 3 and len(told) == 1 and "Traceback" not in done.stderr, done.stderr
    assert list(out.iterdir()) == []
