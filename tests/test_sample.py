"""sample: seeded, without replacement, in proportion to valid area, and no ground shared between parts."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
from geographiclib.geodesic import Geodesic

from schemas import ConfigError, GeometryError
from stages import sample
from stages.physics.maps.ground_tiles import Tiles
from stages.physics.maps.positions import valid_positions


def crops(small_artefacts, tmp_path, **options):
    path = tmp_path / f"crops{len(list(tmp_path.iterdir()))}.h5"
    parts = sample.run(
        small_artefacts["scene"], path, sample.Config(**({"count": 60, "tile_m": 1280, "block": 100} | options))
    )
    with h5py.File(path) as file:
        return parts, {
            name: file[name][...] for name in file if name not in ("y", "x", "pair", "frame", "camera", "start_time")
        }


def paint(data, crop, part):
    ground = np.zeros((384, 384), bool)
    for r, c in zip(data["row"][data["split"] == part], data["col"][data["split"] == part], strict=True):
        ground[r - crop // 2 : r + crop // 2, c - crop // 2 : c + crop // 2] = True
    return ground


@pytest.mark.parametrize("stack", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_parts_share_no_pixel_of_ground(small_artefacts, tmp_path, seed, stack):
    parts, data = crops(small_artefacts, tmp_path, seed=seed, stack=stack)
    ground = [paint(data, 32, part) for part in range(3)]
    for a in range(3):
        assert ground[a].any()
        for b in range(a):
            assert not (ground[a] & ground[b]).any()
    assert [p.pairs for p in parts] == [(data["split"] == k).sum() for k in range(3)]
    for k in range(3):  # pixels of 20 m; map scale within 1e-5 of one here
        assert parts[k].ground_km2 == pytest.approx(ground[k].sum() * 20**2 / 1e6, rel=1e-3)
        assert parts[k].shared_km2 == 0


def test_every_crop_lies_in_valid_data_of_its_own_image(small_artefacts, tmp_path):
    _, data = crops(small_artefacts, tmp_path)
    with h5py.File(small_artefacts["scene"]) as scene:
        for r, c, image in zip(data["row"], data["col"], data["image_index"], strict=True):
            window = np.s_[r - 16 : r + 16, c - 16 : c + 16]
            assert scene["valid"][image][window].all()


def test_same_seed_same_crops_and_no_crop_twice(small_artefacts, tmp_path):
    _, first = crops(small_artefacts, tmp_path, seed=5)
    _, again = crops(small_artefacts, tmp_path, seed=5)
    _, other = crops(small_artefacts, tmp_path, seed=6)
    np.testing.assert_array_equal(first["row"], again["row"])
    assert not np.array_equal(first["row"], other["row"])
    keys = set(zip(first["image_index"].tolist(), first["row"].tolist(), first["col"].tolist(), strict=True))
    assert len(keys) == len(first["row"]) == 60


def test_shares_of_the_split_and_of_the_images(small_artefacts, tmp_path):
    _, data = crops(small_artefacts, tmp_path, count=300)
    counts = np.bincount(data["split"], minlength=3)
    np.testing.assert_array_equal(counts, [240, 30, 30])
    with h5py.File(small_artefacts["scene"]) as scene:
        area = scene["valid_area_m2"][...]
    share = np.bincount(data["image_index"], minlength=3) / 300
    np.testing.assert_allclose(share, area / area.sum(), atol=0.12)  # the guard between tiles takes some of each


def test_stack_crops_every_image_that_covers_a_place(small_artefacts, tmp_path):
    _, data = crops(small_artefacts, tmp_path, stack=True, count=40)
    with h5py.File(small_artefacts["scene"]) as scene:
        size, height, width = int(scene.attrs["crop_px"]), *scene["elevation"].shape
        valid = scene["valid"][...]
        positions = np.stack([valid_positions(v, height, width, (0, 0, height, width), size) for v in valid])
    for site in np.unique(data["site"]):
        mine = data["site"] == site
        r, c = data["row"][mine][0], data["col"][mine][0]
        assert set(data["row"][mine]) == {r}
        assert set(data["col"][mine]) == {c}
        np.testing.assert_array_equal(np.sort(data["image_index"][mine]), np.flatnonzero(positions[:, r, c]))
    assert len(np.unique(data["site"])) == 40
    assert len(data["site"]) > 40


def test_places_of_a_stack_lie_side_by_side_while_there_is_room():
    """On open ground no two crops overlap; where there are more places than room all are taken, as far apart as may be."""
    from stages.sample.places import _pick_apart

    rng = np.random.default_rng(1)
    row, col = rng.integers(0, 400, (2, 2000))
    _, first = np.unique(row * 1000 + col, return_index=True)
    row, col = row[first], col[first]

    def nearest(wanted):
        chosen = np.flatnonzero(_pick_apart(row, col, wanted, 48, rng))
        assert len(chosen) == wanted
        apart = np.maximum(*(np.abs(v[chosen, None] - v[chosen]) for v in (row, col)))
        return apart[~np.eye(wanted, dtype=bool)].min()

    assert nearest(25) >= 48
    assert nearest(100) >= 24
    assert nearest(len(row)) >= 1


def test_tiles_are_metres_on_the_body(small_artefacts, tmp_path):
    """1280 m at 20 m a pixel is 64 pixels; a geodesic along a row of the scene says the same."""
    _, data = crops(small_artefacts, tmp_path)
    with h5py.File(small_artefacts["scene"]) as scene:
        width = scene["x"].shape[0]
    tiles_per_row = -(-width // 64)
    np.testing.assert_array_equal(data["tile"], data["row"] // 64 * tiles_per_row + data["col"] // 64)
    far = np.argmax(data["col"])
    near = np.argmin(data["col"])
    line = Geodesic(1737400, 0).Inverse(
        data["latitude_deg"][near], data["longitude_deg"][near], data["latitude_deg"][far], data["longitude_deg"][far]
    )
    pixels = np.hypot(data["row"][far] - data["row"][near], data["col"][far] - data["col"][near])
    assert line["s12"] == pytest.approx(20 * pixels, rel=1e-5)


def test_shards_make_one_whole(small_artefacts, tmp_path):
    from stages import merge

    whole = tmp_path / "whole.h5"
    config = {"count": 50, "tile_m": 1280.0, "seed": 2, "block": 100}
    sample.run(small_artefacts["scene"], whole, sample.Config(**config))
    parts = []
    for k in range(3):
        parts.append(tmp_path / f"part{k}.h5")
        sample.run(small_artefacts["scene"], parts[-1], sample.Config(**config, shard=(k, 3)))
    merged = tmp_path / "elsewhere" / "merged.h5"
    merge.run([parts[2], parts[0], parts[1]], merged)
    with h5py.File(whole) as a, h5py.File(merged) as b:
        assert (merged.parent / b.attrs["scene"]).resolve() == small_artefacts["scene"].resolve()
        for path in b["path"].asstr():
            assert (merged.parent / path).exists()
        for name in a:
            if a[name].dtype.kind != "O":
                np.testing.assert_array_equal(a[name][...], b[name][...], err_msg=name)


def test_impossible_requests_are_refused(small_artefacts, tmp_path):
    scene, out = small_artefacts["scene"], tmp_path / "c.h5"
    for options, kind, words in [
        ({"tile_m": 100.0}, ConfigError, "at least one crop"),
        ({"crop": 40}, ConfigError, "multiple of 16"),
        ({"count": 5, "density": 1.0}, ConfigError, "one of the two"),
        ({"count": 0}, ConfigError, "`count`: expected 1"),
        ({"crop": 0}, ConfigError, "multiple of 16"),
        ({"tile_m": float("nan")}, ConfigError, "`tile_m`"),
        ({"crop": 320, "tile_m": 6400.0}, GeometryError, "larger than any valid region"),
    ]:
        with pytest.raises(kind, match=words):
            sample.run(scene, out, sample.Config(**options))
        assert not out.exists()


def test_whatever_is_sampled_from_a_scene_is_split_alike(small_artefacts, tmp_path):
    """By image or as a stack, in crops of any size: no training ground of one sample is test ground of another."""
    samples = {}
    for stack, crop in ((False, 32), (True, 16), (False, 16)):
        options = {"stack": stack, "crop": crop, "count": 150, "tile_m": None, "seed": 4, "split": (0.6, 0.15, 0.25)}
        samples[stack, crop] = crops(small_artefacts, tmp_path, **options)[1]
    ids = set()
    for path in tmp_path.glob("crops*.h5"):
        with h5py.File(path) as file:
            ids.add(json.loads(file.attrs["config"])["split_id"])
    assert len(ids) == 1
    ground = [[paint(data, crop, part) for part in range(3)] for (_, crop), data in samples.items()]
    for mine in ground:
        for other in ground:
            for a, b in ((0, 1), (0, 2), (1, 2)):
                assert not (mine[a] & other[b]).any()


def test_other_options_of_the_split_are_another_split(small_artefacts, tmp_path):
    ids = []
    for k, options in enumerate(({}, {"seed": 1}, {"split": (0.6, 0.2, 0.2)}, {"tile_m": 1400.0})):
        path = tmp_path / f"{k}.h5"
        sample.run(small_artefacts["scene"], path, sample.Config(**({"count": 40, "tile_m": 1280.0} | options)))
        with h5py.File(path) as file:
            ids.append(json.loads(file.attrs["config"])["split_id"])
    assert len(set(ids)) == 4


def test_crops_that_are_scored_lie_in_one_tile(small_artefacts, tmp_path):
    """Tiles are the independent units of intervals: those of validation and test must not share ground."""
    _, data = crops(small_artefacts, tmp_path, count=300)
    scored = data["split"] > 0
    for name in ("row", "col"):
        first, last = data[name] - 16, data[name] + 15
        assert (first[scored] // 64 == last[scored] // 64).all()
        assert not (first[~scored] // 64 == last[~scored] // 64).all()


def test_a_scene_with_room_has_twenty_test_tiles(small_artefacts, tmp_path):
    _, data = crops(small_artefacts, tmp_path, tile_m=None, crop=16, count=600, split=(0.5, 0.25, 0.25))
    assert len(np.unique(data["tile"][data["split"] == 2])) >= 20


def test_a_crop_larger_than_the_scene_s_tiles_asks_for_larger_tiles(small_artefacts, tmp_path):
    with pytest.raises(ConfigError, match="`tile_m`"):
        sample.run(small_artefacts["scene"], tmp_path / "c.h5", sample.Config(crop=256, count=5))


def test_a_footprint_ends_where_its_tile_does():
    """Rows 10 to 19 are for testing: crops of 4 px are centred from row 12 to row 18 there, and the ones beside end at row 9."""
    tiles = Tiles(10, np.array([[0], [2], [0]], np.int8))
    row = np.arange(2, 28)
    part = tiles.allowed(row[:, None], np.array([5]), 4)[:, 0]
    assert row[part == 2].tolist() == list(range(12, 19))
    assert row[part == 0].tolist() == [*range(2, 9), *range(22, 28)]
    across = Tiles(10, np.array([[0, 1, 0]], np.int8)).allowed(np.array([[5]]), row, 4)[0]
    assert row[across == 1].tolist() == list(range(12, 19))
