"""normalize: images of a known law come out flat at its standard value, as ISIS computes them, with error bars that hold."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import rasterio
import rasterio.warp
import torch
from albedo_scene import SUNS, axes, photographs, plant, texture
from evaluation_scene import run_command
from photometry_oracles import angles, columns, groups, ours, read
from rasterio.transform import Affine
from small_scene import GSD, LAT, LON, RADIUS, A, B, C, local_crs, slopes, sun_enu, write_raster

from schemas import ConfigError, InputError
from schemas.files.outputs import Output
from stages import ingest, merge, normalize
from stages.normalize.mosaic import combine, fading_weight
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import get_model, get_set, masked_radiance_factor
from stages.physics.photometry.standard import NormalisingFactor, standard_angles

STANDARD = A * np.cos(np.radians(30)) + B * np.cos(np.radians(30)) + C  # of M2 in albedo_scene
QUIET = normalize.Config(geotiff=False)


def maps(path, *names):
    with h5py.File(path) as file:
        return [file[name][...] for name in names]


def factor(model, values, i, e, g, standard=(30, 0, 30)):
    """The factor of a model with some values at angles in radians."""
    tensors = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in values.items()}
    given = Angles.from_angles(*(torch.as_tensor(np.asarray(a, float)) for a in (i, e, g)))
    return masked_radiance_factor(
        NormalisingFactor(get_model(model), standard_angles(*standard)), tensors, given
    ).numpy()


# ---- against ISIS


def test_the_factor_is_isis_mcewen_s(shared):
    """ISIS' LunarLambertMcEwen prints the factor itself, to six digits; its surface without light has the factor 0."""
    rows = [r for r in read(shared / "oracles/isis_photometry_truth.csv") if r["model"] == "LunarLambertMcEwen"]
    expected = columns(rows, "expected")[0]
    found = factor("lunar_lambert", {"albedo": 1.0}, *angles(rows))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert len(rows) == 3 and (expected > 0).sum() >= 2


def test_lambert_s_law_to_the_zenith_is_isis_albedo_mode(shared):
    """ISIS' Albedo mode around Lambert's law brings I/F to the Sun in the zenith: the standard geometry (0, 0, 0).

    Its other modes (Shade, Topo, Mixed) make shaded pictures, and MoonAlbedo adds Buratti's phase curve: no such factor.
    """
    rows = [r for r in read(shared / "oracles/isis_photometry_truth.csv") if r["model"] == "Albedo+Lambert"]
    i, e, g = angles(rows)
    lit = i < np.radians(89)
    found = columns(rows, "dn_in")[0] * factor("lambert", {"albedo": 1.0}, i, e, g, standard=(0, 0, 0))
    assert lit.sum() >= 2
    np.testing.assert_allclose(found[lit], columns(rows, "expected")[0][lit], rtol=1e-5)


def test_a_wac_image_comes_out_as_from_lrowacphomap(shared):
    """3,366 pixels through Sato's map to (60, 0, 60). ISIS takes the numerator from the map's 321 nm and the denominator from
    its 689 nm for an image at 415 nm (README of the tables): the difference is one ratio of I/F at the standard geometry.
    """
    folder = shared / "oracles"
    expected = json.loads((folder / "isis_lrowacphomap_expected.json").read_text())
    rows = read(folder / "isis_lrowacphomap_pixels.csv")
    cells = groups(read(folder / "sato2014_hapke_map_isis_test_reduced.csv"), "band_nm", "cell_sample", "cell_line")
    numerator, denominator = (
        ours("sato:Hapke", {k: float(cells[band, "5", "3"][0][k]) for k in expected["params_at_cell_5_3"][band]})[1]
        for band in ("321", "689")
    )
    there = standard_angles(60, 0, 60)
    swap = [
        masked_radiance_factor(get_model("hapke"), {k: torch.as_tensor(v) for k, v in p.items()}, there).item()
        for p in (numerator, denominator)
    ]
    out = columns(rows, "dn_in_415nm")[0] * factor("hapke", denominator, *angles(rows), standard=(60, 0, 60))
    out *= swap[0] / swap[1]
    assert out.mean() == pytest.approx(expected["average"], rel=1e-4)
    assert out.std(ddof=1) == pytest.approx(expected["standard_deviation"], rel=1e-4)
    assert (out.min(), out.max()) == pytest.approx((expected["minimum"], expected["maximum"]), rel=1e-4)


# ---- a level ground, whose angles have a closed form


def write_angles(path, transform, *planes):
    """As phocube names them. planes : phase, emission, incidence, deg"""
    profile = {"driver": "GTiff", "dtype": "float32", "count": 3, "crs": local_crs(), "transform": transform}
    with rasterio.open(path, "w", height=planes[0].shape[0], width=planes[0].shape[1], **profile) as out:
        out.write(np.stack(planes).astype(np.float32))
        out.descriptions = ("Phase Angle", "Local Emission Angle", "Local Incidence Angle")


def level_frames(folder, frames, gain=None, wrong_by=None):
    """A level ground of Lommel and Seeliger's law, 0.1 x 2 mu0 / (mu0 + mu), seen by cameras near enough that emission and
    phase vary. frames : (sub-solar longitude, camera east, columns shown); gain : (gain, offset) of images in DN
    wrong_by : with a file of angles for each image, whose incidence is wrong by so many degrees
    """
    size, height = 192, 9000.0
    half = size * GSD / 2
    axis = (np.arange(size) + 0.5) * GSD - half
    x, y = (v.ravel() for v in np.meshgrid(axis, -axis))
    transform = Affine(GSD, 0, -half, 0, -GSD, half)
    lon, lat = rasterio.warp.transform(local_crs(), f"+proj=longlat +R={RADIUS}", x, y)

    def unit(lon, lat):
        lon, lat = np.radians(lon), np.radians(lat)
        return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)

    up = unit(lon, lat)
    write_raster(folder / "dem.tif", np.zeros((size, size), np.float32), local_crs(), transform)
    lines = ["image_id,path,units,start_time,subsolar_longitude_deg,subsolar_latitude_deg,solar_distance_au,"
             "spacecraft_longitude_deg,spacecraft_latitude_deg,spacecraft_altitude_m"]  # fmt: skip
    for k, (subsolar, east, shown) in enumerate(frames):
        camera_lon = LON + np.degrees(east / RADIUS / np.cos(np.radians(LAT)))
        view = unit(camera_lon, LAT) * (RADIUS + height) - up * RADIUS
        sun, view = unit(subsolar, 0.0), view / np.linalg.norm(view, axis=-1, keepdims=True)
        mu0, mu = up @ sun, (up * view).sum(-1)
        image = (0.2 * mu0 / (mu0 + mu)).reshape(size, size).astype(np.float32)
        if gain:
            image = gain[k][0] * image + gain[k][1]
        image[:, ~np.isin(np.arange(size), shown)] = -1
        write_raster(folder / f"image{k}.tif", image.astype(np.float32), local_crs(), transform, nodata=-1.0)
        units = "dn" if gain else "iof"
        row = f"F{k},image{k}.tif,{units},,{subsolar},0,1,{camera_lon},{LAT},{height}"
        lines.append(row if wrong_by is None else f"{row},angles{k}.tif")
        phase, emission, incidence = (np.degrees(np.arccos(c)).reshape(size, size) for c in (view @ sun, mu, mu0))
        write_angles(folder / f"angles{k}.tif", transform, phase, emission, incidence + (wrong_by or 0))
    lines[0] += "" if wrong_by is None else ",angles"
    (folder / "images.csv").write_text("\n".join(lines))
    ingest.run(folder / "dem.tif", folder / "images.csv", folder / "scene.h5", ingest.Config(gsd=GSD, crop=32))
    return folder / "scene.h5"


FRAMES = ((-30.0, -2500.0, range(120)), (60.0, 3000.0, range(70, 192)))
FLAT = 0.2 * np.cos(np.radians(30)) / (np.cos(np.radians(30)) + 1)


@pytest.mark.parametrize("gain", [None, ((900.0, 20.0), (300.0, 55.0))], ids=["iof", "dn"])
def test_level_ground_of_a_known_law_comes_out_flat(tmp_path, gain):
    """To 1e-4, across the seam too, for images in I/F and for images with gains and offsets; it stepped by over 10 %."""
    scene = level_frames(tmp_path, FRAMES, gain)
    out = tmp_path / "flat.h5"
    config = replace(QUIET, model="lommel_seeliger", parameters={"albedo": 0.1})
    summary = normalize.run(scene, None, out, config)
    mosaic, images, found, incidence = maps(out, "mosaic", "normalized", "mosaic_images", "phase_high_deg")
    assert found.max() == 2 and len(incidence) == 1
    np.testing.assert_allclose(mosaic[np.isfinite(mosaic)], FLAT, rtol=1e-4)
    np.testing.assert_allclose(images[np.isfinite(images)], FLAT, rtol=1e-4)
    assert summary.before > 0.1 > 1e-3 > summary.after
    if gain:
        for (_, *fitted, _), planted in zip(summary.images, gain, strict=True):
            assert fitted == pytest.approx(planted, rel=1e-3)


def test_a_file_s_angles_are_compared_with_the_terrain_s_and_used_as_asked(tmp_path):
    """Files whose incidence is 5 deg too large: told as such, and used only with ``angles`` "file"."""
    scene = level_frames(tmp_path, FRAMES, wrong_by=5.0)
    config, out = replace(QUIET, model="lommel_seeliger"), tmp_path / "dem.h5"
    summary = normalize.run(scene, None, out, config)
    assert summary.angles["incidence_deg"] == pytest.approx((5, 5), abs=0.01)
    for plane in ("emission_deg", "phase_deg"):
        assert summary.angles[plane] == pytest.approx((0, 0), abs=0.02)
    mosaic = maps(out, "mosaic")[0]
    np.testing.assert_allclose(mosaic[np.isfinite(mosaic)], FLAT, rtol=1e-4)
    given = tmp_path / "file.h5"
    normalize.run(scene, None, given, replace(config, angles="file"))
    own, theirs = (maps(path, "normalized")[0][0] for path in (out, given))
    with rasterio.open(tmp_path / "angles0.tif") as file:
        mu, mu0, wrong = (np.cos(np.radians(file.read(band) - less)) for band, less in ((2, 0), (3, 5), (3, 0)))
    expected = (mu0 / (mu0 + mu)) / (wrong / (wrong + mu))
    known = np.isfinite(own) & np.isfinite(theirs)
    assert known.mean() > 0.5
    np.testing.assert_allclose((theirs / own)[known], expected[known], rtol=2e-3)


def test_files_of_angles_that_are_none_are_one_line(tmp_path):
    scene = level_frames(tmp_path, FRAMES)
    with pytest.raises(
        ConfigError, match="expected files of angles in column 'angles' of the image table, found none for F0, F1"
    ):
        normalize.run(scene, None, tmp_path / "no.h5", replace(QUIET, model="hapke", angles="file"))
    table = (tmp_path / "images.csv").read_text().splitlines()
    (tmp_path / "wrong.csv").write_text("\n".join([f"{table[0]},angles", f"{table[1]},image1.tif"]))
    with pytest.raises(InputError, match=r"image1\.tif: expected bands named incidence, emission and phase"):
        ingest.run(tmp_path / "dem.tif", tmp_path / "wrong.csv", tmp_path / "no.h5", ingest.Config(gsd=GSD, crop=32))


def test_the_bands_of_phocube_are_found_by_their_names(shared):
    """The five bands of a real file of ISIS."""
    from stages.physics.images.angles import angle_bands

    found = angle_bands(shared / "data/formats/wac_backplanes.reduced.cub")
    assert found == {"incidence_deg": 3, "emission_deg": 2, "phase_deg": 1}


def test_a_step_between_images_fades_and_level_takes_it_off(tmp_path):
    """One image is 10 % too bright: the mosaic climbs over the overlap without a jump; --level finds the 10 %."""
    scene = level_frames(tmp_path, FRAMES)
    with rasterio.open(tmp_path / "image1.tif", "r+") as image:
        values = image.read(1)
        image.write(np.where(values > 0, values * np.float32(1.1), values), 1)
    config = replace(QUIET, model="lommel_seeliger")
    normalize.run(scene, None, tmp_path / "step.h5", config)
    row = maps(tmp_path / "step.h5", "mosaic")[0][0, 100]
    assert row[5] == pytest.approx(FLAT, rel=1e-4) and row[-5] == pytest.approx(1.1 * FLAT, rel=1e-4)
    assert np.abs(np.diff(row[3:-3])).max() < 0.01 * FLAT
    summary = normalize.run(scene, None, tmp_path / "level.h5", replace(config, level=True))
    assert summary.images[1][1] / summary.images[0][1] == pytest.approx(1.1, rel=1e-3)
    row = maps(tmp_path / "level.h5", "mosaic")[0][0, 100, 3:-3]
    np.testing.assert_allclose(row, np.sqrt(1.1) * FLAT, rtol=1e-3)


def test_the_command_takes_a_published_set_and_another_geometry(tmp_path):
    scene, out = level_frames(tmp_path, FRAMES, wrong_by=0.0), tmp_path / "standard.h5"
    words = ("--model", "sato2014_415nm", "--parameters", "w=0.3,theta_deg=20", "--standard", "60,0,60")
    code, printed = run_command("normalize", scene, *words, "-o", out)
    assert code == 0 and "F0" in printed and "F1" in printed
    with h5py.File(out) as file, rasterio.open(tmp_path / "image0.tif") as image:
        angles = file.attrs["incidence_deg"], file.attrs["emission_deg"], file.attrs["phase_deg"]
        assert angles == (60, 0, 60) and file.attrs["model"] == "hapke"
        assert json.loads(file.attrs["config"])["parameters"] == {"w": 0.3, "theta_deg": 20}
        ratio = file["normalized"][0, 100, 10] / image.read(1)[100, 10]
    law = get_set("sato2014_415nm").values | {"w": 0.3, "theta": np.radians(20)}
    with rasterio.open(tmp_path / "angles0.tif") as file:
        g, e, i = np.radians(file.read()[:, 100, 10].astype(float))
    assert ratio == pytest.approx(float(factor("hapke", law, i, e, g, (60, 0, 60))), rel=1e-4)


# ---- a ground with relief, albedo and noise


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    rng = np.random.default_rng(7)
    albedo = np.exp(texture(rng))
    scene = plant(tmp_path_factory.mktemp("relief"), albedo, photographs(rng, albedo))
    out = scene.folder / "normalized.h5"
    normalize.run(scene.scene, scene.map, out, replace(QUIET, phase_bins_deg=(20, 40, 60), max_incidence_deg=50))
    return scene, out


def test_the_error_bars_hold(planted):
    """Two thirds of the pixels lie within one standard deviation of the planted albedo at the standard geometry."""
    scene, out = planted
    mosaic, std, images, single = maps(out, "mosaic", "mosaic_std", "normalized", "normalized_std")
    truth = STANDARD * scene.albedo
    inner = np.s_[8:-8, 8:-8]
    for values, errors in [(mosaic[0], std[0]), *zip(images, single, strict=True)]:
        z = ((values - truth) / errors)[inner]
        z = z[np.isfinite(z)]
        assert z.size > 10_000 and 0.55 < np.mean(np.abs(z) < 1) < 0.9, np.mean(np.abs(z) < 1)
    assert np.nanmean(std[0] / mosaic[0]) < 0.8 * np.nanmin(
        [np.nanmean(s / v) for s, v in zip(single, images, strict=True)]
    )


def test_shadow_and_grazing_pixels_are_masked(planted):
    """A pixel has a value where the mask says good; slopes that the Sun meets beyond 50 deg are grazing."""
    _, out = planted
    mask, images = maps(out, "mask", "normalized")
    assert (mask == 3).any()
    np.testing.assert_array_equal(mask == 1, np.isfinite(images))
    x, y = axes()
    east, north = slopes(x, y)
    for k, sun in enumerate(SUNS):
        s = sun_enu(subsolar=sun)
        mu0 = (s[2] - east * s[0] - north * s[1]) / np.sqrt(1 + east**2 + north**2)
        clear, lit = np.abs(np.degrees(np.arccos(mu0)) - 50) > 0.5, mask[k] != 2
        assert (mask[k][clear & lit] == 1).any()
        np.testing.assert_array_equal((mask[k] == 3)[clear & lit], (mu0 < np.cos(np.radians(50)))[clear & lit])


def test_phase_bins_count_their_images(planted):
    """The six Suns stand 45, 30, 35, 50, 40 and 40 deg from the ground; the camera is overhead."""
    _, out = planted
    count, value, name = maps(out, "mosaic_images", "mosaic", "layer_name")
    assert [n.decode() for n in name] == ["", "phase_20_40", "phase_40_60"]
    np.testing.assert_array_equal(count[0], count[1] + count[2])
    both = (count[1] > 0) & (count[2] > 0)
    assert both.any() and np.nanmax(np.abs(value[1] / value[2] - 1)[both]) < 0.25


def test_shards_merge_to_the_same_bytes_and_geotiff(planted, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.physics.images.windows.BLOCK_PX", 128)
    scene, _ = planted
    config = normalize.Config(phase_bins_deg=(20, 60))
    whole, merged = tmp_path / "whole.h5", tmp_path / "merged.h5"
    normalize.run(scene.scene, scene.map, whole, config)
    parts = [tmp_path / f"part{k}.h5" for k in range(2)]
    for k, part in enumerate(parts):
        normalize.run(scene.scene, scene.map, part, replace(config, shard=(k, 2)))
    merge.run(parts, merged)
    names = ("normalized", "normalized_std", "mask", "mosaic", "mosaic_std", "mosaic_scatter", "mosaic_images", "gain")
    for one, other in zip(maps(whole, *names), maps(merged, *names), strict=True):
        np.testing.assert_array_equal(one, other)
    with rasterio.open(whole.with_suffix(".tif")) as one, rasterio.open(merged.with_suffix(".tif")) as other:
        np.testing.assert_array_equal(one.read(), other.read())
        assert one.descriptions[:2] == ("mosaic", "mosaic_phase_20_60")
        np.testing.assert_array_equal(one.read(1), maps(whole, "mosaic")[0][0])
        assert one.tags()["quantity"].endswith("at the standard geometry")


def test_a_set_by_wavelength_needs_one(planted, tmp_path):
    with pytest.raises(ConfigError, match="expected a known wavelength, to choose a set of sato2014, found none"):
        normalize.run(planted[0].scene, None, tmp_path / "n.h5", replace(QUIET, model="sato2014"))


def test_wrong_options_are_one_line(planted, tmp_path):
    scene, _ = planted
    for change, with_map, message in (
        ({}, False, "`model`: expected a reflectance model or an svbrdf.h5, found neither"),
        ({"model": "hapke"}, True, "`model`: .* found both"),
        ({"standard_deg": (30, 0, 40)}, True, "expected a phase of 30 .. 30 deg .* found 40"),
        ({"phase_bins_deg": (40, 20)}, True, "two or more rising angles"),
        ({"max_emission_deg": 0}, True, "`max_emission_deg`: expected degrees above 0"),
        ({"leave_out": ("NONE",)}, True, "`leave_out`: expected an image of the scene"),
    ):
        with pytest.raises(ConfigError, match=message):
            normalize.run(scene.scene, scene.map if with_map else None, tmp_path / "no.h5", replace(QUIET, **change))
    assert not list(tmp_path.iterdir())


# ---- bands


def test_bands_of_one_file_get_mosaics_of_their_own(tmp_path):
    """Band 2 of both images is three times as bright; wavelengths come from the file's tags; no band is no choice."""
    scene = level_frames(tmp_path, FRAMES)
    rows = (tmp_path / "images.csv").read_text().splitlines()
    for k in range(2):
        with rasterio.open(tmp_path / f"image{k}.tif") as one:
            profile, values = one.profile | {"count": 2}, one.read(1)
        with rasterio.open(tmp_path / f"two{k}.tif", "w", **profile) as two:
            for band, (factor, nm) in enumerate(((1, 415), (3, 643)), start=1):
                two.write(np.where(values > 0, factor * values, -1), band)
                two.update_tags(band, wavelength=str(nm), wavelength_units="nm")
    header, *lines = rows
    several = [f"{header},band"]
    for band in (1, 2):
        several += [f"{row.replace('image', 'two').replace('F', f'B{band}F', 1)},{band}" for row in lines]
    table, config = tmp_path / "bands.csv", ingest.Config(gsd=GSD, crop=32)
    table.write_text("\n".join(several))
    ingest.run(tmp_path / "dem.tif", table, Output(scene, overwrite=True), config)
    assert maps(scene, "band", "wavelength_nm")[1].tolist() == [415, 415, 643, 643]
    out = tmp_path / "bands.h5"
    normalize.run(scene, None, out, replace(QUIET, model="lommel_seeliger"))
    name, mosaic, wavelength = maps(out, "layer_name", "mosaic", "wavelength_nm")
    assert name.tolist() == [b"415nm", b"643nm"] and wavelength.tolist() == [415, 415, 643, 643]
    for layer, factor in zip(mosaic, (1, 3), strict=True):
        np.testing.assert_allclose(layer[np.isfinite(layer)], factor * FLAT, rtol=1e-4)
    by_set = {}
    for model in ("sato2014", "sato2014_415nm", "sato2014_643nm"):
        normalize.run(scene, None, Output(out, overwrite=True), replace(QUIET, model=model))
        (by_set[model],) = maps(out, "normalized")
    np.testing.assert_allclose(by_set["sato2014"][:2], by_set["sato2014_415nm"][:2], rtol=1e-6)
    np.testing.assert_allclose(by_set["sato2014"][2:], by_set["sato2014_643nm"][2:], rtol=1e-6)
    assert not np.allclose(by_set["sato2014_415nm"][:2], by_set["sato2014_643nm"][:2], equal_nan=True)
    for cell, message in (
        ("", "expected .* of one band, found 2; name the one that is meant in column 'band'"),
        ("3", "with a band 3, found 2"),
        ("red", "expected the number of a band, 1..65535, in column 'band', found 'red'"),
    ):
        table.write_text("\n".join([several[0], several[1].rpartition(",")[0] + f",{cell}"]))
        with pytest.raises(InputError, match=message):
            ingest.run(tmp_path / "dem.tif", table, Output(scene, overwrite=True), config)


def test_an_isis_cube_tells_the_wavelength_of_its_bands(shared):
    from stages.physics.images.labels import band_wavelength

    cube = shared / "data/formats/M1181493219CE.vis.odd.reduced.cub"
    assert [band_wavelength(cube, band) for band in range(1, 6)] == [415, 566, 604, 643, 689]


# ---- mosaics


def test_one_outlying_image_of_five_hardly_moves_the_mosaic():
    values = np.full((5, 1, 1), 0.1, np.float32) + np.array([-1, 0, 0, 1, 0], np.float32)[:, None, None] * 1e-3
    values[4] = 0.5
    found = combine(values, np.full_like(values, 1e-3), np.ones_like(values))
    assert abs(found.value[0, 0] - 0.1) < 1e-3 and found.count[0, 0] == 5
    assert found.scatter[0, 0] > 0.1


def test_weights_fade_towards_an_edge_and_not_towards_the_end_of_the_map():
    good = np.ones((80, 80), bool)
    good[:, 60:] = False
    weight = fading_weight(good)
    assert weight[40, 0] == weight[0, 0] == 1 and weight[40, 59] < 0.01 and weight[40, 60] == 0
    assert (np.diff(weight[40]) <= 0).all()
