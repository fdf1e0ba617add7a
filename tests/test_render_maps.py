"""`lunargr render` of whole maps: closed forms on known ground, georeference to the pixel, blocks, extensions."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import h5py
import numpy as np
import OpenImageIO as oiio
import pytest
import rasterio
from rasterio.transform import Affine
from relief import RADIUS, hills
from render_scene import LAT, LON, SUN, lunargr_render, make_grid, write_dem, write_svbrdf

from schemas import DIAGNOSIS, ArtefactWriter
from stages import render
from stages.physics.bodies.spheres import find_body
from stages.physics.maps.grid import Grid, unit_vectors
from stages.physics.photometry import evaluate
from stages.physics.terrain import sun_visibility as light
from stages.physics.terrain.surface import open_surface
from stages.render import ortho
from stages.render.pictures import read_exr, stretch


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
    config = render.Config(sun_azimuth_deg=0.0, sun_elevation_deg=40.0, shadows=False, model="lambert")
    render.run(path, tmp_path / "o.exr", config)
    tilt = math.degrees(math.atan(0.2))
    assert read_exr(tmp_path / "o.exr")["incidence_deg"][50, 50] == pytest.approx(50.0 - tilt, abs=0.05)


def test_ortho_image_is_the_model_at_the_backplanes_angles_and_the_map_to_the_pixel(hilly_map, tmp_path):
    path, grid, _, coefficients = hilly_map
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
        assert tif.tags()["model"] == "M2"
        np.testing.assert_array_equal(tif.read(1), exr["image"])
    picture = oiio.ImageBuf(str(tmp_path / "o.png"))
    pixels = picture.get_pixels(oiio.UINT8)
    assert pixels.shape == (160, 200, 2)
    assert (pixels[20:40, 60:90] == 0).all()
    assert (pixels[:20, :, 1] == 255).all()
    assert 40 < np.median(pixels[..., 0]) < 240


def test_blocks_make_no_difference(hilly_map, tmp_path, monkeypatch):
    path, *_ = hilly_map
    config = render.Config(sun_azimuth_deg=100.0, sun_elevation_deg=20.0)
    render.run(path, tmp_path / "whole.exr", config)
    monkeypatch.setattr(ortho, "BAND_ROWS", 33)
    monkeypatch.setattr(ortho, "BAND_COLUMNS", 71)
    render.run(path, tmp_path / "blocks.exr", config)
    whole, blocks = read_exr(tmp_path / "whole.exr"), read_exr(tmp_path / "blocks.exr")
    for name in whole:
        np.testing.assert_allclose(
            blocks[name], whole[name], atol=2e-3 if name.endswith("_deg") else 1e-5, err_msg=name
        )


def test_horizons_in_blocks_agree_with_one_sweep(hilly_map, tmp_path, monkeypatch):
    """Large maps take the horizon block by block; the shadows must be those of the whole map."""
    path, *_ = hilly_map
    config = render.Config(sun_azimuth_deg=100.0, sun_elevation_deg=12.0)
    render.run(path, tmp_path / "whole.exr", config)
    monkeypatch.setattr(light, "WHOLE_PX", 0)
    monkeypatch.setattr(light, "BLOCK_PX", 64)
    render.run(path, tmp_path / "blocks.exr", config)
    whole, blocks = (read_exr(tmp_path / f"{n}.exr")["shadow"] for n in ("whole", "blocks"))
    assert 0.02 < (whole > 0.5).mean() < 0.6
    assert ((whole > 0.5) != (blocks > 0.5)).mean() < 0.004


def test_a_dem_with_one_model_everywhere(rng, tmp_path, monkeypatch, capsys):
    grid = make_grid(64, 64, 10.0)
    elevation = hills(rng, 64, 10.0)
    elevation[5:9, 5:9] = np.nan
    dem = write_dem(tmp_path / "dem.tif", grid, elevation)
    code, error = lunargr_render(
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


def test_an_angle_of_a_model_may_be_given_in_degrees(rng, tmp_path):
    path = write_dem(tmp_path / "dem.tif", make_grid(30, 30, 10.0), hills(rng, 30, 10.0))
    body = find_body("moon")
    found = []
    for parameters in ({"theta_deg": 20.0}, {"theta": math.radians(20.0)}):
        with open_surface(path, "hapke", parameters, body) as surface:
            found.append(surface.uniform)
    np.testing.assert_array_equal(*found)


def test_extensions_reach_both_kinds_of_view(hilly_map, tmp_path):
    """A pedestal of known height is added in the sensor slot, by the ortho view and by the camera alike."""
    path, *_ = hilly_map
    extension = json.dumps([{"effect": "dark_bias", "values": {"iof": 0.007}, "survey": {}}])
    attributes = {"report": "{}", "extension": extension}
    with ArtefactWriter(tmp_path / "diagnosis.h5", DIAGNOSIS, {"frame": 1}, attributes=attributes) as writer:
        writer.write("image_id", ["one"])
    sun = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 35.0}
    view = {"view": "pinhole", "position": (LON, LAT, 4000.0), "fov_deg": 8.0, "size_px": (48, 48)}
    for name, changes in (("map", {}), ("view", view)):
        base, more = tmp_path / f"{name}.exr", tmp_path / f"{name}_more.exr"
        render.run(path, base, render.Config(**sun, **changes))
        render.run(path, more, render.Config(**sun, **changes, extend=str(tmp_path / "diagnosis.h5")))
        difference = read_exr(more)["image"] - read_exr(base)["image"]
        known = np.isfinite(difference)
        assert known.mean() > 0.9
        assert np.median(difference[known]) == pytest.approx(0.007, abs=3e-4)


def grazing_map(rng, path):
    """A map whose M2 falls below 0 wherever cos(i) < 1/2: 0.1 cos(i) - 0.05."""
    grid = make_grid(64, 64, 5.0)
    coefficients = np.broadcast_to(np.array([0.1, 0.0, -0.05])[:, None, None], (3, 64, 64))
    return write_svbrdf(path, grid, hills(rng, 64, 5.0), coefficients)


@pytest.mark.parametrize("extended", [False, True])
def test_what_a_model_gives_below_0_is_drawn_as_0_and_counted(rng, tmp_path, monkeypatch, extended):
    """M2 with such coefficients is below 0 exactly where the incidence angle is above 60 deg."""
    path = grazing_map(rng, tmp_path / "svbrdf.h5")
    if extended:  # through the whole formation chain, as with a diagnosis

        class Nothing:
            slot = "sensor"

            def apply(self, state) -> None:
                pass

        monkeypatch.setattr("stages.effects.load_extension", lambda *_: [Nothing()])
    config = render.Config(
        sun_azimuth_deg=100.0, sun_elevation_deg=29.0, shadows=False, extend=str(path) if extended else None
    )
    summary = render.run(path, tmp_path / "o.exr", config)
    exr = read_exr(tmp_path / "o.exr")
    below = (exr["incidence_deg"] > 60.0) & (exr["incidence_deg"] < 90.0)
    assert below.any() and not below.all()
    assert float(np.nanmin(exr["image"])) == 0.0
    assert abs(summary.clipped - int(below.sum())) <= 0.01 * below.sum()


def test_a_camera_view_clips_each_ray_and_counts_pixels(rng, tmp_path):
    path = grazing_map(rng, tmp_path / "svbrdf.h5")
    config = render.Config(
        view="pinhole", position=(LON, LAT, 2000.0), size_px=(32, 32), fov_deg=6.0, samples=2, shadows=False,
        sun_azimuth_deg=100.0, sun_elevation_deg=29.0,
    )  # fmt: skip
    summary = render.run(path, tmp_path / "o.exr", config)
    image = read_exr(tmp_path / "o.exr")["image"]
    assert float(np.nanmin(image)) >= 0.0 and 0 < summary.clipped < image.size


def test_black_is_0_in_a_preview_whatever_the_image_holds():
    image = np.array([[-0.005, 0.0, 0.05, 0.1]] * 50, np.float32)
    grey, limits = stretch(image)
    assert limits[0] == 0.0 and (grey[:, :2] == 0).all() and (grey[:, 2:] > 100).all()


def test_deviations_of_the_map_reach_the_image(tmp_path):
    """Lambert: what an albedo is unsure of times cos(i), where the Sun shines, and the images' own noise on top."""
    grid = make_grid(96, 96, 5.0)
    shape = (grid.height, grid.width)
    path = write_svbrdf(tmp_path / "m.h5", grid, np.zeros(shape), np.full((1, *shape), 0.1), model="lambert")
    sigma = np.broadcast_to(np.linspace(0.001, 0.01, grid.width, dtype=np.float32), shape)
    with h5py.File(path, "r+") as file:
        file.create_dataset("coefficients_std", data=sigma[None])
        file.create_dataset("map_name", data=["albedo"])
        file.attrs["image_noise"] = 0.002
    render.run(path, tmp_path / "o.exr", render.Config(sun_azimuth_deg=100.0, sun_elevation_deg=35.0))
    exr = read_exr(tmp_path / "o.exr")
    cosine = np.cos(np.radians(exr["incidence_deg"]))
    np.testing.assert_allclose(exr["image_std"], np.hypot(sigma * cosine, 0.002), rtol=1e-3)

    # through a camera, each pixel has what the map says of the ground that it sees
    config = render.Config(
        view="pinhole", position=(LON, LAT, 3000.0), size_px=(40, 40), fov_deg=5.0, sun_azimuth_deg=100.0,
        sun_elevation_deg=35.0,
    )  # fmt: skip
    render.run(path, tmp_path / "view.exr", config)
    view = read_exr(tmp_path / "view.exr")
    _, col = grid.rowcol_of_lonlat(view["longitude_deg"], view["latitude_deg"])
    expected = np.interp(col, np.arange(grid.width), sigma[0]) * np.cos(np.radians(view["incidence_deg"]))
    np.testing.assert_allclose(view["image_std"], np.hypot(expected, 0.002), rtol=1e-3)
    render.run(
        path, tmp_path / "coarse.exr", replace(config, fov_deg=7.0, size_px=(8, 8))
    )  # several px of the map each
    coarse = read_exr(tmp_path / "coarse.exr")
    assert (np.diff(coarse["image_std"], axis=1) > 0).all() and np.isfinite(coarse["image_std"]).all()
