"""Invented relief: the DEM's means stay, it depends on the place alone, and its laws are the published ones."""

from __future__ import annotations

import json
import math
import runpy

import numpy as np
import OpenImageIO as oiio
import pytest
from conftest import ROOT
from relief import hills
from render_scene import LAT, LON, SUN, lunargr_render, make_grid, write_dem

from schemas.errors import ConfigError
from stages import render
from stages.physics.horizon import cast_shadow
from stages.physics.maps.grid import Grid, local_metric_crs
from stages.physics.maps.window import Window
from stages.physics.relief.cells import draw_places
from stages.physics.relief.craters import cumulative_density
from stages.physics.relief.detail import Detail, spline_through_means
from stages.physics.relief.noise import gradient_noise3
from stages.physics.relief.rocks import add_rocks, rock_density, rock_diameters
from stages.render.pictures import read_exr

GSD, SIZE = 5.0, 96
NOON = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 30.0}


def area_mean(z, n):
    return z.astype(float).reshape(z.shape[0] // n, n, z.shape[1] // n, n).mean((1, 3))


@pytest.fixture(scope="module")
def ground():
    """A rough DEM with a hole, and its grid."""
    rng = np.random.default_rng(8)
    z = hills(rng, SIZE, GSD, 0.15) + 0.1 * rng.normal(size=(SIZE, SIZE)).astype(np.float32) - 1500
    z[70:74, 20:30] = np.nan
    return z.astype(np.float32), make_grid(SIZE, SIZE, GSD)


@pytest.mark.parametrize("finer", [2, 8, 32])
def test_the_mean_over_a_dem_pixel_stays_the_dems(ground, finer):
    z, grid = ground
    window = Window(50, 10, 30, 24) if finer < 32 else Window(60, 18, 16, 8)
    heights = Detail(z, grid, 3, 0.02).heights(window, finer)
    known = np.isfinite(z[window.part])
    np.testing.assert_allclose(area_mean(heights, finer)[known], z[window.part][known], atol=3e-4)
    assert np.isnan(area_mean(heights, finer)[~known]).all() and not known.all()
    smooth = spline_through_means(np.nan_to_num(z[window.part], nan=-1500.0), finer)
    assert (heights - smooth)[4 * finer : 8 * finer].std() > 0.01


def test_ground_is_the_same_in_every_crop_and_every_order(ground):
    """Another crop, with tiles of its own, drawn after other places."""
    z, grid = ground
    whole, crop = Detail(z, grid, 5, 0.02), Detail(z[9:, 5:], grid.window(9, 5, SIZE - 9, SIZE - 5), 5, 0.02)
    window = Window(48, 52, 6, 7)
    crop.heights(Window(60, 60, 4, 4), 16)
    a, b = whole.heights(window, 16), crop.heights(Window(39, 47, 6, 7), 16)
    np.testing.assert_allclose(a, b, atol=1e-3)
    other = Detail(z, grid, 6, 0.02).heights(window, 16)
    assert np.abs(a - other).max() > 0.05


def test_ground_is_the_same_on_a_map_with_another_projection():
    """Craters lie where they lie on the body: on maps about two places the same ones come."""
    places = []
    for lon in (LON, LON + 0.3):
        crs = local_metric_crs(lon, LAT, 1737400.0)
        from rasterio.transform import Affine

        grid = Grid(crs.to_wkt(), Affine(5, 0, -10000, 0, -5, 10000), 4000, 4000, 1737400.0)
        row, col = grid.rowcol_of_lonlat(LON, LAT)
        x, y, numbers = draw_places(grid, (row - 60, row + 60), (col - 60, col + 60), 100.0, 1e-3, (4, 0, 9), 2)
        lon_lat = np.stack(grid.map_lonlat(x, y))
        near = np.hypot(*(lon_lat - [[LON], [LAT]])) < 0.006
        places.append(np.concatenate([lon_lat, numbers.T])[:, near][:, np.argsort(numbers[near, 0])])
    np.testing.assert_allclose(*places, atol=1e-9)
    assert places[0].shape[1] > 20


@pytest.mark.parametrize("latitude", [0.0, 50.0, 89.9999])
def test_places_are_as_many_as_the_density_says(latitude):
    crs = local_metric_crs(10.0, min(latitude, 89.0), 1737400.0) if latitude < 89 else polar_crs()
    from rasterio.transform import Affine

    grid = Grid(crs.to_wkt(), Affine(5, 0, -10000, 0, -5, 10000), 4000, 4000, 1737400.0)
    x, y, numbers = draw_places(grid, (500, 3500), (500, 3500), 700.0, 2e-4, (1, 2, 3), 1)
    expected = 2e-4 * (3000 * 5.0) ** 2
    assert len(x) == pytest.approx(expected, abs=4 * math.sqrt(expected))
    quarters = np.histogram2d(x, y, bins=2)[0]
    assert np.abs(quarters - expected / 4).max() < 5 * math.sqrt(expected / 4)
    assert numbers.mean() == pytest.approx(0.5, abs=0.01)


def polar_crs():
    from rasterio.crs import CRS

    return CRS.from_proj4("+proj=stere +lat_0=90 +lon_0=0 +k=1 +R=1737400 +units=m +no_defs")


def test_craters_follow_the_equilibrium_law():
    grid = make_grid(400, 400, 5.0)
    craters = Detail(np.zeros((400, 400), np.float32), grid, 2, 0.01)._craters(grid, Window(0, 0, 400, 400), 4.0, 15.0)
    inside = (np.abs(craters.x) < 1000) & (np.abs(craters.y) < 1000)
    for low, high in ((4.0, 6.0), (6.0, 10.0), (10.0, 15.0)):
        expected = 4e6 * float(cumulative_density(low, 1.0, 200.0) - cumulative_density(high, 1.0, 200.0))
        found = (inside & (craters.diameter >= low) & (craters.diameter < high)).sum()
        assert found == pytest.approx(expected, abs=4 * math.sqrt(expected))


@pytest.mark.parametrize("abundance", [0.01, 0.07, 0.3])
def test_rocks_cover_what_the_law_says(abundance):
    """F(D) = k exp(-q D), q = 1.79 + 0.152 / k (Golombek & Rapp 1997): by areas of rocks drawn, and of those on the ground."""
    low, high, q = 0.2, 1.6, 1.79 + 0.152 / abundance
    share = abundance * (math.exp(-q * low) - math.exp(-q * high))
    density = float(rock_density(low, abundance) - rock_density(high, abundance))
    d = rock_diameters((np.arange(20000) + 0.5) / 20000, low, high, abundance)
    assert density * np.mean(math.pi / 4 * d**2) == pytest.approx(share, rel=0.01)
    z = np.zeros((200, 200), np.float32)
    add_rocks(z, -5.0, 5.0, 0.05, np.array([0.3]), np.array([-0.4]), np.array([1.2]))
    assert (z > 0).sum() * 0.05**2 == pytest.approx(math.pi / 4 * 1.2**2, rel=0.05)
    assert z.sum() * 0.05**2 == pytest.approx(math.pi / 12 * 1.2**3, rel=0.02) and z.max() == pytest.approx(
        0.6, abs=0.01
    )


def test_noise_in_space_is_even_in_all_directions(rng):
    places = rng.uniform(-500, 500, (20000, 3))
    values = np.array([gradient_noise3(*p, 7) for p in places])
    assert abs(values.mean()) < 4 * values.std() / math.sqrt(len(values))
    for axis in np.eye(3):
        near = np.array([gradient_noise3(*p, 7) for p in places[:4000] + 0.25 * axis])
        assert np.corrcoef(near, values[:4000])[0, 1] == pytest.approx(0.8, abs=0.1)


@pytest.fixture(scope="module")
def dem(ground, tmp_path_factory):
    z, grid = ground
    return write_dem(tmp_path_factory.mktemp("dem") / "dem.tif", grid, z)


LOW = {"position": (LON, LAT, -1420.0), "fov_deg": 40.0, "size_px": (120, 90)}


def test_a_stereo_pair_sees_the_same_invented_ground(dem):
    """Places that both cameras see are equally high in both."""
    with render.Renderer(dem, model="lambert", samples=1, detail=4) as renderer:
        one = renderer.view(LOW, NOON)
        two = renderer.view({**LOW, "position": (LON + 0.0003, LAT, -1400.0), "look_at": (LON, LAT)}, NOON)
        plain = renderer.surface
    assert plain.grid.gsd == GSD
    points = []
    for frame in (one, two):
        line, sample = np.nonzero(np.isfinite(frame.depth))
        origins, directions = frame.camera.rays(line + 0.5, sample + 0.5)
        points.append(origins + frame.depth[line, sample, None] * directions)
    line, sample = two.camera.ground_to_image(points[0])
    inside = (line > 1) & (sample > 1) & (line < 89) & (sample < 119)
    expected = np.linalg.norm(points[0] - two.camera.centre, axis=1)[inside]
    seen = two.depth[line[inside].astype(int), sample[inside].astype(int)]
    assert inside.mean() > 0.3 and np.nanmedian(np.abs(seen - expected)) < 0.15
    assert np.nanstd(one.invented) > 0.02 and np.nanmax(np.abs(one.invented)) < 3


def test_depths_are_those_of_the_refined_surface_and_shadows_its_own(dem, ground):
    z, grid = ground
    with render.Renderer(dem, model="lambert", samples=1, detail=4) as renderer:
        frame = renderer.view(LOW, {**NOON, "sun_elevation_deg": 12.0})
        layers = renderer.bands(frame.camera, renderer.light(render.Config(view="pinhole", **NOON), frame.camera), 1)[
            0
        ].layers
    assert [layer.ground.finer for layer in layers] == [1, 16]
    refined = layers[-1].ground
    heights = Detail(z, grid, 4, 0.01).heights(refined.window, 16)
    np.testing.assert_array_equal(refined.field.elevation, heights)
    line, sample = (v.ravel() for v in np.mgrid[5:85:4, 5:115:4])
    origins, directions = frame.camera.rays(line + 0.5, sample + 0.5)
    points = origins + frame.depth[line, sample, None] * directions
    lon, lat = frame.longitude_deg[line, sample], frame.latitude_deg[line, sample]
    row, col = refined.grid.rowcol_of_lonlat(lon.astype(float), lat.astype(float))
    r, c = np.rint(row).astype(int), np.rint(col).astype(int)
    miss = np.linalg.norm(points, axis=1) - grid.radius - heights[r, c]
    assert np.median(np.abs(miss)) < 0.03
    whole = Detail(z, grid, 4, 0.01).heights(Window(24, 24, 48, 48), 16)
    frames = grid.local_frames(SIZE / 2, SIZE / 2)
    azimuth = math.radians(100.0 + float(frames.convergence_deg[0]))
    dark = cast_shadow(whole, GSD / 16, azimuth, math.radians(12.0), grid.radius)
    r, c = r + 16 * (refined.window.row - 24), c + 16 * (refined.window.col - 24)
    facing = frame.incidence_deg[line, sample] < 88
    assert np.mean(dark[r, c][facing] == (frame.shadow[line, sample][facing] > 0.5)) > 0.97
    assert 0.005 < dark.mean() < 0.9


def test_the_command_marks_what_it_invents(dem, tmp_path, monkeypatch, capsys):
    view = ("--dem", dem, "--model", "lambert", "--position", f"{LON},{LAT},-1420", "--size", "60,40", *SUN, "-q")
    for name, options in (("a", ("--detail", "4")), ("b", ("--detail", "4")), ("plain", ())):
        code, error = lunargr_render(monkeypatch, capsys, *view, *options, "-o", tmp_path / f"{name}.exr")
        assert code == 0, error
    a, b, plain = (read_exr(tmp_path / f"{name}.exr") for name in ("a", "b", "plain"))
    np.testing.assert_array_equal(a["image"], b["image"])
    assert "invented" not in plain and np.nanstd(a["invented"]) > 0.01
    assert np.nanstd(a["image"]) > 1.3 * np.nanstd(plain["image"])
    image = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    assert "invented" in image.spec().getattribute("lunargr:invented")
    assert "detail=4" in image.spec().getattribute("lunargr:config")
    image.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--view", "ortho", "--detail", "1"), "--detail"),
        (
            ("--position", f"{LON},{LAT},-1400", "--fov", "9", "--rock-abundance", "0.1"),
            "--rock-abundance: expected with --detail",
        ),
        (("--position", f"{LON},{LAT},-1400", "--detail", "1", "--rock-abundance", "0.9"), "expected a share"),
        (("--position", f"{LON},{LAT},-1400", "--detail", "1", "--bounce"), "--bounce"),
    ],
)
def test_detail_that_cannot_be_is_refused(dem, tmp_path, monkeypatch, capsys, arguments, words):
    common = ("--dem", dem, "--model", "lambert", *SUN, "-o", tmp_path / "v.exr")
    code, error = lunargr_render(monkeypatch, capsys, *common, *arguments)
    assert code == 3 and words in error and error.count("\n") == 1 and not list(tmp_path.glob("v*"))


def test_far_above_nothing_is_invented(dem):
    """Where a picture's pixels are the DEM's, or larger."""
    with render.Renderer(dem, model="lambert", samples=1, detail=4) as renderer:
        frame = renderer.view({**LOW, "position": (LON, LAT, 4000.0), "fov_deg": 5.0, "size_px": (40, 40)}, NOON)
    assert np.nanmax(np.abs(frame.invented)) == 0
    with pytest.raises(ConfigError, match="bounce"):
        render.Renderer("nothing.tif", model="lambert", detail=1, bounce=True)


@pytest.mark.slow
def test_a_reduced_dem_with_detail_looks_like_the_whole_one():
    judge = runpy.run_path(str(ROOT / "tests" / "validation" / "detail.py"))
    found = judge["summarise"]([judge["judge"](512, seed)[0] for seed in (7, 8)])
    print(json.dumps(found))
    power, sift = found["power_of_whole"], found["sift_per_km2"]
    for kind in ("slope", "brightness"):
        below, above, _ = power[kind]["with detail"]
        assert 0.75 < above / below < 1.33 and 0.75 < above < 1.33, kind
        assert power[kind]["without"][1] < 0.4, kind
    for with_detail, without, whole in zip(sift["with detail"], sift["without"], sift["whole"], strict=True):
        assert with_detail == pytest.approx(whole, rel=0.35)
        assert without < 0.3 * whole
    assert sum(sift["with detail"]) == pytest.approx(sum(sift["whole"]), rel=0.2)
