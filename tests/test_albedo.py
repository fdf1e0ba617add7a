"""albedo: what photographs share comes into the map, what one of them shows alone does not; the error bars hold."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import rasterio
from albedo_scene import NOISE, SIZE, SUNS, photograph, photographs, plant, texture
from evaluation_scene import run_command
from scipy.ndimage import shift

from schemas import ArtefactError, ConfigError, InputError
from schemas.files.outputs import Output
from stages import albedo, merge
from stages.photographs.posterior import Spread, estimate, robust_mean
from stages.photographs.pyramid import LEVELS

QUIET = albedo.Config(geotiff=False)


def read(path, *names):
    with h5py.File(path) as file:
        return [file[name][...] for name in names]


def made(planted, config=QUIET, name="albedo.h5"):
    """(albedo, std, images) of a planted scene."""
    out = planted.folder / name
    albedo.run(planted.map, planted.scene, None, Output(out, overwrite=True), config)
    return read(out, "albedo", "albedo_std", "albedo_images")


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """Six photographs of textured ground with a ray that no terrain shows; one corner that none of them sees."""
    rng = np.random.default_rng(5)
    log_albedo = texture(rng)
    log_albedo[60:64, :] += 0.4
    images = photographs(rng, np.exp(log_albedo))
    for image in images:
        image[:, :100] = np.where(np.arange(SIZE)[:, None] > 80, np.nan, image[:, :100])
    return plant(tmp_path_factory.mktemp("planted"), np.exp(log_albedo), images)


@pytest.fixture(scope="module")
def found(planted):
    return made(planted)


def rms(values) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def test_a_known_albedo_comes_back_within_its_error_bars(planted, found):
    factor, std, images = found
    seen = images == len(SUNS)
    away = np.log(factor / planted.albedo)[seen]
    assert rms(away - away.mean()) < 0.2 * np.log(planted.albedo)[seen].std()
    z = (factor - planted.albedo)[seen] / std[seen]
    assert 0.58 < np.mean(np.abs(z) < 1) < 0.95
    assert np.mean(np.abs(z) < 1.96) > 0.90


def test_a_ray_that_terrain_does_not_show_is_in_the_map(found):
    ray, beside = (np.log(found[0][rows, 120:]).mean() for rows in (slice(61, 63), slice(70, 90)))
    assert 0.35 < ray - beside < 0.45


def test_where_no_photograph_looks_the_map_stays_and_the_error_bar_says_so(planted, found):
    factor, std, images = found
    far = np.s_[-16:, :16]
    assert (images[far] == 0).all()
    np.testing.assert_allclose(factor[far], 1, atol=0.03)
    spread = rms(np.log(planted.albedo))
    assert 0.5 * spread < std[far].mean() < 2 * spread
    assert std[images == len(SUNS)].mean() < 0.3 * std[far].mean()


def test_a_shadow_or_a_cosmic_ray_in_one_image_leaves_no_mark(planted, found, rng, tmp_path):
    clean, truth, images = found[0], planted.albedo, [image.copy() for image in planted.images]
    images[2][100:130, 110:150] *= 0.1
    images[4][rng.integers(0, SIZE, 60), rng.integers(110, SIZE, 60)] = 1.0
    marked, _, _ = made(plant(tmp_path, truth, images))
    assert rms(np.log(marked / clean)[100:130, 110:150]) < 0.02
    assert rms(np.log(marked / truth)) < 1.5 * rms(np.log(clean / truth)) + 0.002
    assert np.nanmax(np.abs(np.log(marked / clean))) < 0.1


def test_what_one_image_shows_alone_loses_its_weight(rng):
    """A pixel 20 sigma from what five other images agree on counts a hundredth; its neighbours keep theirs."""
    ratio = rng.normal(0, 0.01, (6, 32, 32)).astype(np.float32)
    ratio[2, 16, 16] += 0.2
    confidence = np.ones_like(ratio)
    spread = Spread(
        np.full(LEVELS + 1, 0.04), np.full((6, LEVELS + 1), 1e-4), 0.04, np.full(6, 1e-4), np.zeros(LEVELS + 1)
    )
    location = robust_mean(ratio, confidence, spread)
    assert confidence[2, 16, 16] < 0.03 * np.median(confidence[2])
    assert np.median(confidence) > 0.5 and abs(location[16, 16]) < 0.02


def test_shifted_images_count_less(rng, tmp_path):
    truth = np.exp(texture(rng))
    images = photographs(rng, truth)
    images[1] = np.roll(images[1], 2, axis=1)
    shifted = plant(tmp_path, truth, images)
    factor, _, _ = made(shifted)
    (own,) = read(tmp_path / "albedo.h5", "albedo_image_std")
    assert own[1, 0] > 2 * np.median(own[:, 0])
    without, _, _ = made(shifted, replace(QUIET, leave_out=("IMG1",)), "without.h5")
    plain = np.mean(
        [np.log(image / photograph(np.ones_like(truth), sun)) for image, sun in zip(images, SUNS, strict=True)], 0
    )
    inner = np.s_[8:-8, 8:-8]
    error, best, mean = (rms(log[inner] - np.log(truth)[inner]) for log in (np.log(factor), np.log(without), plain))
    assert error < 1.15 * best
    assert error < 0.4 * mean


def test_where_photographs_do_not_agree_the_map_stays(rng, tmp_path):
    """Each image with a texture of its own, in DN: a mean of ratios would put a sixth of each into the map."""
    ground = np.ones((SIZE, SIZE))
    images = [900.0 * photograph(ground, sun) * np.exp(texture(rng)) + 40.0 for sun in SUNS]
    factor, std, _ = made(plant(tmp_path, ground, images, units="dn"))
    contrast = rms(texture(rng))
    assert rms(np.log(factor)) < 0.25 * contrast / np.sqrt(len(SUNS))
    # what is not known is not certain either
    assert np.median(std) > 0.4 * contrast


def test_one_photograph_alone_moves_nothing_and_leaves_the_map_uncertain(planted, tmp_path):
    others = tuple(f"IMG{k}" for k in range(1, len(SUNS)))
    factor, std, _ = made(planted, replace(QUIET, leave_out=others), "one.h5")
    np.testing.assert_allclose(factor, 1, atol=1e-6)
    spread = rms(np.log(planted.albedo) - np.log(planted.albedo).mean())
    assert 0.5 * spread < np.median(std) < 3 * spread


@pytest.fixture(scope="module")
def deviated(planted, tmp_path_factory):
    """The map with deviations of its network: 10 % of I/F on the left, 30 % on the right."""
    path = tmp_path_factory.mktemp("deviated") / "svbrdf.h5"
    path.write_bytes(planted.map.read_bytes())
    with h5py.File(path, "r+") as file:
        level = file["coefficients"][...]
        cosine = np.cos(np.radians(30))
        # M2: I/F = a mu0 + b cos of the Sun's zenith + c; here all of its error is c's
        brightness = (level[0] + level[1]) * cosine + level[2]
        share = np.where(np.arange(SIZE) < SIZE // 2, 0.1, 0.3)
        file["coefficients_std"] = (share * brightness)[None].astype("f4")
        file["map_name"] = np.array(["c"], h5py.string_dtype())
        file.attrs["image_noise"] = 1e-3
    return path


@pytest.fixture(scope="module")
def corrected(planted, deviated, tmp_path_factory):
    """Albedo of the map with deviations."""
    out = tmp_path_factory.mktemp("corrected") / "albedo.h5"
    albedo.run(deviated, planted.scene, None, out, QUIET)
    return out


def test_where_no_photograph_looks_the_error_bar_is_the_networks(deviated, corrected):
    factor, std, images, kept = read(corrected, "albedo", "albedo_std", "albedo_images", "coefficients_std")
    np.testing.assert_array_equal(kept, read(deviated, "coefficients_std")[0])
    far = np.s_[-16:, :16]
    assert (images[far] == 0).all()
    np.testing.assert_allclose(std[far] / factor[far], 0.1, rtol=0.1)
    seen = images == len(SUNS)
    assert std[seen].mean() < 0.03  # photographs know better than the network


@pytest.mark.usefixtures("found")
def test_renderings_take_their_error_bar_from_the_albedo_alone(planted, deviated, corrected):
    """The network's deviations, which the photographs have corrected, are not counted once more."""
    before, after = (rendering(path) for path in (deviated, corrected))
    seen = read(corrected, "albedo_images")[0][20:120, 90:170] == len(SUNS)
    assert seen.any()
    relative = (after["image_std"] / after["image"])[seen]
    assert (relative > 0).all() and np.median(relative) < 0.05
    assert np.median((before["image_std"] / before["image"])[seen]) > 0.1
    # maps whose network gave no deviations have the error bar of their albedo as well
    assert "image_std" in rendering(planted.folder / "albedo.h5") and "image_std" not in rendering(planted.map)


def rendering(path):
    """The window [20:120, 90:170] of a map under one Sun."""
    from stages.physics.bodies.spheres import find_body
    from stages.physics.terrain.shading import Light, shade_block
    from stages.physics.terrain.sun import sun_from_angles
    from stages.physics.terrain.surface import open_surface

    with open_surface(path, None, {}, find_body("moon")) as surface:
        return shade_block(surface, Light(sun_from_angles(90.0, 40.0, surface.grid), None, None), 20, 90, 100, 80)


def test_gain_and_offset_of_images_in_dn_do_not_matter(rng, tmp_path):
    truth = np.exp(texture(rng))
    images = photographs(rng, truth)
    scaled = [(300.0 + 200.0 * k) * image + 5.0 * k for k, image in enumerate(images)]
    factor, _, _ = made(plant(tmp_path, truth, scaled, units="dn"))
    away = np.log(factor / truth)
    assert rms(away - away.mean()) < 0.35 * np.log(truth).std()


@pytest.mark.slow
def test_shards_and_parts_give_the_same_bytes(planted, tmp_path, monkeypatch):
    # blocks so small that the map has a row of them for each part
    monkeypatch.setattr("stages.physics.images.windows.BLOCK_PX", 96)
    config = replace(QUIET, geotiff=True)
    names = ("albedo", "albedo_std", "albedo_images", "coefficients", "elevation", "albedo_gain", "albedo_image_std")
    whole = tmp_path / "whole.h5"
    albedo.run(planted.map, planted.scene, None, whole, config)
    parts = [tmp_path / f"part{k}.h5" for k in range(3)]
    for k, part in enumerate(parts):
        albedo.run(planted.map, planted.scene, None, part, replace(config, shard=(k, 3)))
    merge.run(parts, tmp_path / "merged.h5")
    # an interrupted run: its calibration and first part are there, the rest is made by the next
    resumed = tmp_path / "resumed.h5"
    with monkeypatch.context() as broken:
        broken.setattr("stages.merge.run", interrupt)
        with pytest.raises(KeyboardInterrupt):
            albedo.run(planted.map, planted.scene, None, Output(resumed, resume=True, parts=3), config)
    left = sorted((tmp_path / "resumed.h5.parts").rglob("map-*.h5"))
    left[1].unlink()
    albedo.run(planted.map, planted.scene, None, Output(resumed, resume=True, parts=3), config)
    for other in ("merged", "resumed"):
        for name, a, b in zip(names, read(whole, *names), read(tmp_path / f"{other}.h5", *names), strict=True):
            assert a.tobytes() == b.tobytes(), (other, name)
        with rasterio.open(whole.with_suffix(".tif")) as a, rasterio.open(tmp_path / f"{other}.tif") as b:
            assert a.descriptions == b.descriptions == ("a", "b", "c", "albedo", "albedo_std")
            assert a.read().tobytes() == b.read().tobytes()


def interrupt(*arguments, **options):
    raise KeyboardInterrupt


def test_blocks_leave_no_seams(planted, found, monkeypatch):
    monkeypatch.setattr("stages.physics.images.windows.BLOCK_PX", 128)
    blocks = made(planted, name="blocks.h5")[0]
    assert np.nanmax(np.abs(np.log(blocks / found[0]))) < 0.1 * np.nanmedian(found[1])


def test_rendering_multiplies_by_the_albedo(planted, found):
    images = [rendering(path)["image"] for path in (planted.map, planted.folder / "albedo.h5")]
    np.testing.assert_allclose(images[1], images[0] * found[0][20:120, 90:170], rtol=1e-5)


@pytest.mark.usefixtures("found")
def test_held_out_images_are_never_those_that_made_the_albedo(planted, tmp_path):
    from stages import project, sample

    crops, pairs = tmp_path / "crops.h5", tmp_path / "pairs.h5"
    sample.run(planted.scene, crops, sample.Config(count=60, tile_m=640, seed=1))
    project.run(crops, pairs, project.Config())
    folds = [tmp_path / f"fold{k}.h5" for k in range(2)]
    for k, path in enumerate(folds):
        albedo.run(planted.map, planted.scene, None, path, replace(QUIET, fold=(k, 2)))
    out = tmp_path / "evaluation.h5"
    code, _ = run_command("held-out", pairs, *folds, "-o", out)
    assert code == 0
    result = json.loads(out.with_suffix(".json").read_text())
    assert result["claim"] == "seen ground, unseen images"
    assert result["models"]["albedo"]["mse"] < 0.1 * result["models"]["terrain"]["mse"]
    assert result["models"]["albedo"]["mse"] < 6 * NOISE**2
    assert result["nearest_used_sun_deg"]["least"] > 1.0
    one, used = tmp_path / "one.h5", [f"IMG{k}" for k in (1, 3, 5)]
    code, _ = run_command("held-out", pairs, folds[0], "-o", one)
    assert code == 0
    scored = json.loads(one.with_suffix(".json").read_text())["images"]
    assert {row["image_id"] for row in scored} == {f"IMG{k}" for k in (0, 2, 4)}
    assert read(folds[0], "albedo_image_id")[0].astype(str).tolist() == used
    everything = planted.folder / "albedo.h5"
    code, said = run_command("held-out", pairs, everything, "-o", tmp_path / "no.h5")
    assert code == 3 and "--fold" in said and not (tmp_path / "no.h5").exists()


def test_bad_input_is_refused_in_one_line(planted, found, tmp_path):
    out = tmp_path / "out.h5"

    def refused(error, words, svbrdf=planted.map, scene=planted.scene, output=out, config=QUIET):
        with pytest.raises(error, match=words) as caught:
            albedo.run(svbrdf, scene, None, Output(output, overwrite=True), config)
        assert "\n" not in str(caught.value)
        assert not out.exists()

    def changed(source, name, change):
        copy = tmp_path / f"{name}.h5"
        copy.write_bytes(source.read_bytes())
        with h5py.File(copy, "r+") as file:
            change(file)
        return copy

    refused(ArtefactError, "already", svbrdf=planted.folder / "albedo.h5")
    refused(ConfigError, "replace the input", output=planted.map)
    refused(ConfigError, "replace the input", output=planted.scene)
    refused(ConfigError, "found 'IMG9'", config=replace(QUIET, leave_out=("IMG9",)))
    refused(ConfigError, "at least one image", config=replace(QUIET, leave_out=tuple(f"IMG{k}" for k in range(6))))
    other_body = changed(planted.map, "body", lambda f: f.attrs.modify("body_radius_m", 3389500.0))
    refused(ArtefactError, "body_radius_m", svbrdf=other_body)
    moved = changed(planted.map, "moved", lambda f: f["crs"].attrs.modify("GeoTransform", "100 20 0 2560 0 -20"))
    refused(ArtefactError, "the grid of", svbrdf=moved)
    mixed = changed(planted.scene, "mixed", lambda f: f["units"].write_direct(np.array([0, 0, 1, 1, 0, 0], np.uint8)))
    relative(mixed, planted.scene)
    refused(InputError, "both 'iof' and 'dn'", scene=mixed)
    in_dn = changed(planted.map, "dn", lambda f: f.attrs.create("image_units", "dn"))
    refused(InputError, "found I/F", svbrdf=in_dn)
    nowhere = changed(planted.scene, "nowhere", lambda f: f["frame_window"].write_direct(np.zeros((6, 4), np.int32)))
    refused(InputError, "overlap the map", scene=nowhere)
    unknown = changed(
        planted.map, "unknown", lambda f: f["coefficients"].write_direct(np.full((3, SIZE, SIZE), np.nan, "f4"))
    )
    refused(InputError, "overlap the map", svbrdf=unknown)


def relative(copy, source):
    """Images named relative to a scene elsewhere."""
    with h5py.File(copy, "r+") as file:
        for k, name in enumerate(file["path"].asstr()[...]):
            file["path"][k] = str(source.parent / name)


def test_of_images_that_an_outlier_befell_the_most_precise_one_has_no_last_word():
    """A cosmic ray in the image of least noise: its weight alone must not choose what the others are measured by."""
    size = 16
    ratio = np.zeros((4, size, size), np.float32)
    ratio[0, 8, 8] = 3.0
    own_px = np.array([1e-5, 1e-3, 1e-3, 1e-3])
    levels = np.ones(LEVELS + 1)
    spread = Spread(0.01 * levels, own_px[:, None] * levels, 0.01, own_px, 0.01 * levels)
    confidence = np.ones_like(ratio)
    assert abs(robust_mean(ratio, confidence, spread)[8, 8]) < 0.1
    assert confidence[0, 8, 8] < 1e-3 * np.median(confidence[0])


def test_noisy_images_weigh_less():
    """Two images that differ everywhere alike: the mean by inverse variances, its deviation that of the two together."""
    size = 64
    ratio = np.stack([np.full((size, size), v, np.float32) for v in (0.1, -0.1)])
    own = np.repeat([[0.01], [0.04]], LEVELS + 1, axis=1)
    spread = Spread(np.full(LEVELS + 1, 1e6), own, 1e6, own[:, 0], np.full(LEVELS + 1, 1e6))
    mean, _ = estimate(ratio, np.ones_like(ratio), spread)
    np.testing.assert_allclose(mean, (0.1 / 0.01 - 0.1 / 0.04) / (1 / 0.01 + 1 / 0.04), rtol=1e-3)


def test_what_registration_finds_is_taken_off_by_all_shards(rng, tmp_path, monkeypatch):
    """Images three pixels aside: where that is told, the albedo is as sharp as if they were not, whoever reads them."""
    from stages.photographs.calibrate import Calibration, read_calibration, write_calibration
    from stages.physics.images.displacement import Basis, Field

    truth = np.exp(texture(rng))
    images = [shift(image, (0, 3), mode="nearest") for image in photographs(rng, truth)]
    scene = plant(tmp_path, truth, images)
    aside = Field(Basis("constant", (0.0, 0.0)), np.array([[3.0], [0.0]]), 16, 16, 0.1, 0.1, 0.9)
    monkeypatch.setattr(
        "stages.photographs.ground.register", lambda references, form, progress: [aside] * len(references.frames)
    )
    config = replace(QUIET, register="constant")
    inner = np.s_[8:-8, 8:-8]
    whole = made(scene, config)[0]
    away = np.log(whole / truth)[inner]
    # three pixels aside, an image differs from the ground by more than the ground's own contrast
    assert rms(away - away.mean()) < 0.25 * np.log(truth).std()
    path, again, part = (tmp_path / name for name in ("calibration.json", "again.json", "part.h5"))
    albedo.calibrate_to(scene.map, scene.scene, path, config)
    made_from = json.loads(path.read_text())["made_from"]
    kept = Calibration.from_text(read_calibration(path, made_from, "albedo"))
    write_calibration(again, kept.as_text(), made_from)
    assert again.read_bytes() == path.read_bytes()
    monkeypatch.setattr("stages.photographs.ground.Ground.calibrate", None)  # shards have no need of it
    albedo.run(scene.map, scene.scene, path, part, config)
    np.testing.assert_array_equal(read(part, "albedo")[0], whole)
    with pytest.raises(ArtefactError, match=r"calibration\.json: .* found another \(register\)"):
        albedo.run(scene.map, scene.scene, path, tmp_path / "other.h5", QUIET)
    for text in ("no JSON", "[]", '{"made_from": 1}'):
        path.write_text(text)
        with pytest.raises(ArtefactError, match=r"calibration\.json: expected "):
            albedo.run(scene.map, scene.scene, path, tmp_path / "other.h5", config)


def test_an_unknown_form_of_registration_is_refused(planted, tmp_path):
    with pytest.raises(ConfigError, match=r"register`: expected one of constant, affine, field, found 'rubber'"):
        made(planted, replace(QUIET, register="rubber"), "no.h5")
    assert not (planted.folder / "no.h5").exists()


def test_of_a_tilted_strip_only_the_windows_that_it_crosses_are_read():
    from stages.physics.images.footprints import CELL_PX, MARGIN_PX, read_footprint

    rows, cols = np.arange(1500)[:, None], np.arange(1400)[None, :]
    valid = np.abs(cols - 100 - 0.8 * rows) < 60
    valid[700:] = False
    box = (0, int(np.argmax(valid.any(axis=0))), 700, int(valid.any(axis=0).sum()))
    footprint = read_footprint(valid[None], 0, box)
    reach = CELL_PX + MARGIN_PX
    for row in range(0, 1500, 100):
        for col in range(0, 1400, 100):
            found = footprint.within((row, col, 100, 100))
            seen = np.argwhere(valid[row : row + 100, col : col + 100]) + (row, col)
            near = valid[max(0, row - reach) : row + 100 + reach, max(0, col - reach) : col + 100 + reach]
            assert (found is not None) >= bool(len(seen)) and (found is None or near.any())
            if found is not None and len(seen):
                top, left, height, width = found
                assert (seen.min(axis=0) >= (top, left)).all() and (
                    seen.max(axis=0) < (top + height, left + width)
                ).all()
                assert row <= top and col <= left and top + height <= row + 100 and left + width <= col + 100
    whole = footprint.within((0, 0, 1500, 1400))
    assert whole is not None and all(abs(a - b) <= 2 * reach for a, b in zip(whole, box, strict=True))


def test_images_beside_each_other_give_what_images_of_the_whole_map_give(planted, found, tmp_path, monkeypatch):
    """A window that an image fills in part holds the same as if the image had been read over all of it."""
    monkeypatch.setattr("stages.physics.images.footprints.CELL_PX", 16)
    for mine, whole in zip(made(planted, name="cells.h5"), found, strict=True):
        np.testing.assert_allclose(mine, whole, rtol=2e-3, atol=2e-3)
