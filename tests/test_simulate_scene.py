"""The simulated files, read back as a stranger would: GDAL, the image table, plain vector geometry."""

from __future__ import annotations

import csv
import json
import math

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.warp import Resampling, reproject

from schemas import TRUTH, ConfigError, InputError, RegistryError, open_artefact
from stages.simulate import make_config, read_recipe, recipe_json, run, stage
from stages.simulate import radiance as render_module

R = 1737400.0
SMALL = {"size_px": 288, "images": 10, "crater_largest": 260.0, "hidden": [], "seed": 3}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    config = make_config(SMALL)
    return folder, config, run(folder, config)


@pytest.fixture(scope="module")
def table(scene):
    with open(scene[0] / "images.csv") as stream:
        return list(csv.DictReader(stream))


def unit(lon, lat):
    lon, lat = math.radians(float(lon)), math.radians(float(lat))
    return np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])


def enu(lon, lat):
    up = unit(lon, lat)
    east = np.cross([0, 0, 1], up)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def directions(config, row):
    """Unit vectors to the Sun and the camera at the scene's centre, ENU, from the table alone."""
    axes = enu(config.longitude_deg, config.latitude_deg)
    place = axes[2] * (R + config.base_elevation)
    sun = unit(row["subsolar_longitude_deg"], row["subsolar_latitude_deg"])
    sun = sun * float(row["solar_distance_au"]) * 149597870700.0 - place
    camera = unit(row["spacecraft_longitude_deg"], row["spacecraft_latitude_deg"])
    camera = camera * (R + float(row["spacecraft_altitude_m"])) - place
    return tuple(axes @ (v / np.linalg.norm(v)) for v in (sun, camera))


def read_image(path):
    with rasterio.open(path) as d:
        values = d.read(1, masked=True)
        return values.astype(float).filled(np.nan) * d.scales[0] + d.offsets[0], d.transform, d.crs


def on_dem(path, dem):
    values, transform, crs = read_image(path)
    out = np.full(dem.shape, np.nan, np.float32)
    reproject(
        values.astype(np.float32),
        out,
        src_transform=transform,
        src_crs=crs,
        dst_transform=dem.transform,
        dst_crs=dem.crs,
        src_nodata=np.nan,
        dst_nodata=np.nan,
        resampling=Resampling.cubic,
    )
    return out


def test_dem_is_a_metric_map_of_the_moon_with_gaps(scene):
    folder, config, summary = scene
    with rasterio.open(folder / "dem.tif") as d:
        assert d.dtypes == ("float32",) and d.shape == (576, 576) and d.res == (2.5, 2.5)
        assert d.crs.is_projected and "1737400" in d.crs.to_wkt()
        z = d.read(1, masked=True)
    share = 1 - z.mask.mean()
    assert 0.85 < share < 0.999 and abs(share - summary.dem_valid) < 1e-9
    assert abs(z.mean() - config.base_elevation) < 200
    components = cv2.connectedComponents(z.mask[8:-8, 8:-8].astype(np.uint8))[0] - 1
    assert components >= config.dem_holes  # holes inside, beside the ragged edge


def test_images_have_their_own_grids_and_ragged_footprints(scene, table):
    folder, _, _ = scene
    with rasterio.open(folder / "dem.tif") as d:
        dem_wkt, dem_res = d.crs.to_wkt(), d.res
    kinds, resolutions, raggedness = set(), set(), []
    for row in table:
        with rasterio.open(folder / row["path"]) as d:
            assert d.nodata is not None and "1737400" in d.crs.to_wkt() and d.crs.to_wkt() != dem_wkt
            kinds.add((d.dtypes[0], d.scales[0]))
            resolutions.add(d.res[0])
            mask = d.read_masks(1) > 0
        assert d.res != dem_res
        assert 0.05 < 1 - mask.mean() < 0.8
        rows = np.flatnonzero(mask.any(1))[10:-10]
        raggedness.append(np.argmax(mask[rows], 1).std())
    assert {k for k, _ in kinds} == {"float32", "int16"} and all(s != 1 for k, s in kinds if k == "int16")
    assert len(resolutions) > 5 and np.median(raggedness) > 2


def test_geometry_is_that_of_an_orbiter(scene, table):
    _, config, _ = scene
    incidence, emission, azimuth = [], [], []
    for row in table:
        sun, camera = directions(config, row)
        incidence.append(math.degrees(math.acos(sun[2])))
        emission.append(math.degrees(math.acos(camera[2])))
        azimuth.append(math.degrees(math.atan2(sun[0], sun[1])) % 360)
        assert 50e3 <= float(row["spacecraft_altitude_m"]) <= 100e3
        assert 0.98 < float(row["solar_distance_au"]) < 1.02
        assert abs(float(row["subsolar_latitude_deg"])) < 1.6
    incidence, emission, azimuth = map(np.array, (incidence, emission, azimuth))
    assert incidence.min() > 19 and incidence.max() < 81 and np.ptp(incidence) > 40
    assert (emission > 11).sum() == 3 and (emission < 7).sum() == 7 and emission.max() < 36
    east = (azimuth > 0) & (azimuth < 180)
    assert 3 <= east.sum() <= 7


def test_start_time_has_that_sun(scene, table):
    """The mean Sun: a mean lunar day of 29.530589 days; a new moon puts the Sun over 180 E (full moon 0 E)."""
    full_moon = np.datetime64("2010-01-30T06:18")  # almanac
    for row in table:
        days = (np.datetime64(row["start_time"].rstrip("Z")) - full_moon) / np.timedelta64(1, "D")
        mean = -360.0 * days / 29.530589
        off = (float(row["subsolar_longitude_deg"]) - mean + 180) % 360 - 180
        assert abs(off) < 16  # libration in longitude and the unequal month


def test_truth_agrees_with_the_table(scene, table):
    folder, config, _ = scene
    with open_artefact(folder / "truth.h5", TRUTH) as truth:
        assert json.loads(truth.attrs["hidden"]) == []
        for k, row in enumerate(table):
            sun, camera = directions(config, row)
            assert abs(math.degrees(math.acos(sun[2])) - truth["incidence_deg"][k]) < 0.02
            assert abs(math.degrees(math.acos(camera[2])) - truth["emission_deg"][k]) < 0.1
            assert abs(math.degrees(math.acos(sun @ camera)) - truth["phase_deg"][k]) < 0.1
        elevation, standard = truth["elevation"][...], truth["standard_iof"][...]
        geometry, free = truth["log_albedo_geometry"][...], truth["log_albedo_free"][...]
    with rasterio.open(folder / "dem.tif") as d:
        z = d.read(1, masked=True).filled(np.nan).astype(float).reshape(288, 2, 288, 2).mean((1, 3))
    good = np.isfinite(z)
    assert np.abs(elevation - z)[good].max() < 0.25 and abs(np.std((elevation - z)[good]) - 0.025) < 0.004
    assert 0.03 < standard.mean() < 0.12  # lunar I/F at 30 deg phase, from mare to highland
    assert geometry.std() > 0.02 and free.std() > 0.02
    assert abs(np.corrcoef(geometry.ravel(), free.ravel())[0, 1]) < 0.5


def test_a_sensor_makes_the_images_dn(tmp_path):
    """Counts are the sensor's gain times what the same scene has in I/F, with its noise; a full well ends them."""
    numbers = {"full_well": 20000, "gain": 10.0, "bits": 12, "offset_dn": 50, "read_noise": 20, "auto_level": 1.2}
    (tmp_path / "sensor.json").write_text(json.dumps(numbers))
    recipe = SMALL | {"images": 1, "psf_sigma_px": 0.0, "read_noise": 0.0, "full_well": 1e6}
    run(tmp_path / "iof", make_config(recipe))
    run(tmp_path / "dn", make_config(recipe | {"sensor": str(tmp_path / "sensor.json")}))
    with open_artefact(tmp_path / "dn" / "truth.h5", TRUTH) as truth:
        gain, offset = float(truth["gain"][0]), float(truth["offset"][0])
    with open(tmp_path / "dn" / "images.csv") as stream:
        row = next(csv.DictReader(stream))
    with rasterio.open(tmp_path / "iof" / row["path"]) as a, rasterio.open(tmp_path / "dn" / row["path"]) as b:
        iof, counts = a.read(1, masked=True), b.read(1, masked=True)
        iof = iof * a.scales[0]
    assert row["units"] == "dn" and offset == 50
    full = counts[gain * iof > 2300].astype(float)
    assert full.size > 50 and full.mean() == pytest.approx(2050, abs=1)  # read noise comes after the full well
    below = ~iof.mask & ~counts.mask & (gain * iof < 1500)
    miss = (counts - offset - gain * iof)[below].astype(float)
    electrons = 10.0 * (gain * iof[below]).mean()
    assert miss.mean() == pytest.approx(0, abs=0.3)
    assert miss.std() == pytest.approx(math.sqrt(electrons + 20**2) / 10.0, rel=0.05)


def predicted(dem, sun):
    """Lambert's cosine from the DEM alone."""
    z = dem.read(1, masked=True).filled(np.nan).astype(float)
    gy, gx = np.gradient(z, dem.res[0])
    return np.clip((sun[2] - gx * sun[0] + gy * sun[1]) / np.sqrt(1 + gx**2 + gy**2), 0, None)


def offset_between(a, b):
    """(right, down) px by which the content of b is displaced from that of a."""
    good = np.isfinite(a) & np.isfinite(b)
    rows, cols = (np.flatnonzero(m > 0.8 * m.max()) for m in (good.mean(1), good.mean(0)))
    cut = (slice(rows[0], rows[-1]), slice(cols[0], cols[-1]))

    def clean(v):
        v = np.where(good, v, np.nanmean(v[good]))[cut]
        v = v - cv2.GaussianBlur(v, (0, 0), 12)
        return np.clip(v / v.std(), -4, 4)

    first, second = clean(a), clean(b)
    return cv2.phaseCorrelate(first, second, cv2.createHanningWindow(first.shape[::-1], cv2.CV_64F))[0]


def test_images_lie_on_the_dem(tmp_path):
    """Even ground under Lambert's law: what the DEM alone predicts must lie on the image to a small part of a pixel."""
    plain = {"model": "lambert", "geometry_contrast": 0, "free_contrast": 0, "dem_error": 0}
    config = make_config(SMALL | plain | {"images": 3, "incidence_deg": [40, 55], "oblique_share": 0.5})
    run(tmp_path, config)
    with rasterio.open(tmp_path / "dem.tif") as dem, open(tmp_path / "images.csv") as stream:
        for row in csv.DictReader(stream):
            sun, _ = directions(config, row)
            image = on_dem(tmp_path / row["path"], dem).astype(float)
            shading = predicted(dem, sun)
            right, down = offset_between(shading, image)
            assert math.hypot(right, down) < 0.1, row["image_id"]
            good = np.isfinite(image) & np.isfinite(shading)
            assert np.corrcoef(image[good], shading[good])[0, 1] > 0.93
            assert np.mean(image[good]) == pytest.approx(0.12 * np.mean(shading[good]), rel=0.02)


def test_relief_shows_in_every_image_with_a_low_sun(scene, table):
    folder, config, _ = scene
    with rasterio.open(folder / "dem.tif") as dem:
        for row in table:
            sun, _ = directions(config, row)
            if math.degrees(math.acos(sun[2])) > 50:
                image, shading = on_dem(folder / row["path"], dem).astype(float), predicted(dem, sun)
                good = np.isfinite(image) & np.isfinite(shading)
                assert np.corrcoef(image[good], shading[good])[0, 1] > 0.4


def test_same_seed_same_files_and_bands_do_not_matter(scene, tmp_path, monkeypatch):
    """A scene cut into small blocks, with its truth on disk, is the one made at once."""
    folder, config, _ = scene
    monkeypatch.setattr(stage, "GROUND_ROWS", 100)
    monkeypatch.setattr(stage, "IN_MEMORY", 0)
    monkeypatch.setattr(stage, "WINDOW_PIXELS", 60_000)
    monkeypatch.setattr(render_module, "WHOLE", 0)
    run(tmp_path / "again", config)
    for name in ("dem.tif", "images/S0001N.tif", "images/S0002N.tif"):
        if not (folder / name).exists():
            name = name.replace("N.tif", "O.tif")
        first, second = read_image(folder / name)[0], read_image(tmp_path / "again" / name)[0]
        assert np.array_equal(np.isfinite(first), np.isfinite(second))
        difference = np.abs(first - second)[np.isfinite(first)]
        assert np.percentile(difference, 99) < (5e-3 if name == "dem.tif" else 1.5e-4)
    assert not list((tmp_path / "again").glob(".truth-*"))
    assert (tmp_path / "again" / "images.csv").read_bytes() == (folder / "images.csv").read_bytes()


def test_uncalibrated_images_hide_a_gain_and_an_offset(scene, tmp_path):
    folder, _, _ = scene
    config = make_config(SMALL | {"units": "dn", "images": 10})
    run(tmp_path, config)
    with open(tmp_path / "images.csv") as stream:
        row = next(csv.DictReader(stream))
    assert row["units"] == "dn"
    with rasterio.open(tmp_path / row["path"]) as d:
        assert d.dtypes == ("uint16",) and d.nodata == 0
    dn, iof = read_image(tmp_path / row["path"])[0], read_image(folder / row["path"])[0]
    good = np.isfinite(dn) & np.isfinite(iof)
    gain, offset = np.polyfit(iof[good], dn[good], 1)
    with open_artefact(tmp_path / "truth.h5", TRUTH) as truth:
        assert gain == pytest.approx(truth["gain"][0], rel=0.05)
        assert offset == pytest.approx(truth["offset"][0], rel=0.15, abs=8)


def test_recipe_goes_round(tmp_path):
    config = make_config(
        {"size_px": 100, "swath": [0.6, 0.7], "parameters": {"w": 0.4}, "hidden": [{"effect": "echo"}]}
    )
    (tmp_path / "recipe.json").write_text(recipe_json(config))
    assert make_config(read_recipe(tmp_path / "recipe.json")) == config


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"size": 3}, ConfigError, "unknown key 'size'"),
        ({"size_px": "big"}, ConfigError, "'size_px': expected"),
        ({"size_px": 8}, ConfigError, "expected 64 .."),
        ({"gsd": 5.0, "dem_gsd": 2.0}, ConfigError, "whole multiple"),
        ({"incidence_deg": [40, 20]}, ConfigError, "low <= high"),
        ({"latitude_deg": 60, "incidence_deg": [20, 40]}, ConfigError, "never below"),
        ({"units": "radiance"}, ConfigError, "'iof' or 'dn'"),
        ({"hidden": [{"effect": "gremlins"}]}, RegistryError, "dark_bias"),
        ({"hidden": [{"effect": "dark_bias", "iof": 9}]}, ConfigError, "-0.05..0.05"),
    ],
)
def test_a_bad_recipe_is_one_clear_line(values, error, words):
    with pytest.raises(error) as caught:
        make_config(values)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_bad_files_and_existing_outputs(scene, tmp_path):
    folder, config, _ = scene
    with pytest.raises(InputError, match="no such file"):
        read_recipe(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        read_recipe(tmp_path / "bad.json")
    before = (folder / "dem.tif").stat().st_mtime_ns
    with pytest.raises(ConfigError, match="`overwrite`"):
        run(folder, config)
    assert (folder / "dem.tif").stat().st_mtime_ns == before
    with pytest.raises(RegistryError, match="reflectance model"):
        run(tmp_path / "x", make_config({"model": "velvet"}))


def test_command_prints_a_recipe_that_it_reads_back(tmp_path, capsys):
    from lunargr_cli.commands.simulate import command

    command(print_recipe=True, extent_m=1000.0, gsd=2.0, images=5, seed=9, hidden="echo:lag_px=2")
    text = capsys.readouterr().out
    (tmp_path / "recipe.json").write_text(text)
    config = make_config(read_recipe(tmp_path / "recipe.json"))
    assert (config.size_px, config.gsd, config.dem_gsd, config.images, config.seed) == (500, 2.0, 1.0, 5, 9)
    assert list(config.hidden_effects()) == ["echo"]
    with pytest.raises(ConfigError, match="one of them"):
        command(print_recipe=True, size_px=100, extent_m=1000.0)
