"""Matchers on pictures whose displacement is known, sizes and masks, and the command line."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from evaluation_scene import make_scene, run_command, write_pairs

from schemas import ConfigError, InputError, RegistryError
from stages import evaluate, match, train
from stages.match.base import Matches, Models, get_matcher, matchers, mutual_nearest
from stages.match.comparisons import choose
from stages.match.consistency import summarise
from stages.match.daisy import Field, dense_descriptors
from stages.match.pictures import drop_unknown, fit_size, to_grey

PLAIN = [matcher.name for matcher in matchers() if not matcher.needs_models]


@pytest.fixture(scope="module")
def texture():
    """A picture of blobs of several sizes, larger than needed, so that it can be shifted without edges."""
    rng = np.random.default_rng(5)
    field = sum(s * cv2.GaussianBlur(rng.normal(size=(460, 600)), (0, 0), s) for s in (3, 6, 12))
    return np.uint8(np.clip(128 + 40 * field / field.std(), 0, 255))


def _window(picture, dx, dy):
    return np.ascontiguousarray(picture[30 + dy : 30 + dy + 384, 40 + dx : 40 + dx + 512])


@pytest.mark.parametrize("name", PLAIN)
def test_a_known_shift_is_found(texture, name):
    matches = get_matcher(name).match(_window(texture, 0, 0), _window(texture, 7, -4))
    assert len(matches.errors) > 300
    shift = np.median(matches.rendered - matches.measured, axis=0)
    assert shift == pytest.approx([-7, 4], abs=0.05)
    right = np.linalg.norm(matches.rendered - matches.measured - [-7, 4], axis=1) < 1
    assert right.mean() > 0.9


@pytest.mark.parametrize("name", PLAIN)
def test_unrelated_pictures_match_nowhere_near(texture, name):
    other = np.ascontiguousarray(texture[::-1, ::-1])
    errors = get_matcher(name).match(_window(texture, 0, 0), _window(other, 0, 0)).errors
    assert len(errors) == 0 or np.mean(errors <= 5) < 0.1


@pytest.mark.parametrize("name", PLAIN)
def test_flat_pictures_have_no_matches(name):
    flat = np.full((384, 512), 90, np.uint8)
    assert len(get_matcher(name).match(flat, flat).errors) == 0


def test_coarse_to_fine_search_finds_the_exact_neighbour(texture, rng):
    noisy = np.clip(texture + 6 * rng.normal(size=texture.shape), 0, 255).astype(np.uint8)
    first, second = dense_descriptors(_window(texture, 0, 0)), dense_descriptors(_window(noisy, 3, 2))
    queries = first[::997]
    exact = (queries @ second.T).argmax(dim=1)
    assert (Field(second, 512).nearest(queries) == exact).float().mean() > 0.98


def test_mutual_nearest_keeps_only_reciprocal_pairs():
    first = np.float32([[0, 0], [1, 0], [9, 9]])
    second = np.float32([[1.1, 0], [0.1, 0], [4, 4]])
    here, there = mutual_nearest(first, second)
    assert sorted(zip(here.tolist(), there.tolist(), strict=True)) == [
        (0, 1),
        (1, 0),
    ]  # (9, 9) chose (4, 4), which prefers (1, 0)
    assert len(mutual_nearest(first, np.empty((0, 2), np.float32))[0]) == 0


def test_summary_of_known_errors():
    def displaced(*right):
        here = np.zeros((len(right), 2))
        return Matches(here, here + np.stack([right, np.zeros(len(right))], axis=1))

    row = summarise([displaced(0.0, 0.5, 2.0, 4.0), displaced(10.0)], [4, 7])
    assert row["matches"] == 5 and row["crops"] == 2 and row["tiles"] == 2
    assert [row[f"within_{t}_px_percent"] for t in (1, 3, 5)] == pytest.approx([40, 60, 80])
    assert row["mean_error_px"] == pytest.approx(3.3) and row["median_error_px"] == 2.0
    assert row["within_5_px_percent_low"] == pytest.approx(0) and row["within_5_px_percent_high"] == pytest.approx(100)
    assert row["median_shift_right_px"] == 2.0 and row["median_shift_down_px"] == 0.0
    assert summarise([displaced()], [0])["within_1_px_percent"] is None


def test_crops_of_one_tile_are_one_witness():
    """The same matches from two tiles or from ten crops of two tiles say equally much; one tile alone says no interval."""

    def hits(share):
        here = np.zeros((100, 2))
        return Matches(here, here + [[0.0 if k < 100 * share else 9.0, 0.0] for k in range(100)])

    shares = [0.4, 0.5, 0.6, 0.45]
    few = summarise([hits(s) for s in shares], range(4))
    many = summarise([hits(s) for s in shares for _ in range(5)], np.repeat(range(4), 5))
    for end in ("low", "high"):
        assert many[f"within_1_px_percent_{end}"] == pytest.approx(few[f"within_1_px_percent_{end}"])
    assert 25 < few["within_1_px_percent_low"] < 48.75 < few["within_1_px_percent_high"] < 75
    assert summarise([hits(s) for s in shares], [3] * 4)["within_1_px_percent_low"] is None


def test_crops_are_drawn_from_as_many_tiles_as_there_are():
    tile = np.repeat([0, 1, 2, 3], [40, 4, 2, 1])
    chosen = choose(np.ones(47), tile, 8, seed=0)
    assert np.bincount(tile[chosen]).tolist() == [3, 2, 2, 1]


def test_a_square_crop_keeps_its_middle_four_times_as_large():
    crop = np.add.outer(np.zeros(128), np.arange(128.0))
    fitted = fit_size(crop)
    assert fitted.shape == (384, 512)
    assert fitted[100, 8:-8] == pytest.approx((np.arange(512)[8:-8] + 0.5) / 4 - 0.5, abs=0.05)
    rows = fit_size(np.add.outer(np.arange(128.0), np.zeros(128)))[:, 50]
    assert rows.mean() == pytest.approx(63.5, abs=1e-3) and rows[0] == pytest.approx((64 + 0.5) / 4 - 0.5, abs=0.05)


def test_unknown_pixels_are_no_place_for_a_match():
    image = np.linspace(0, 1, 128 * 128, dtype=np.float32).reshape(128, 128)
    image[:, :64] = np.nan
    _, known = to_grey(image, (0.0, 1.0))
    points = np.array([[100.0, 200.0], [400.0, 200.0]])
    kept = drop_unknown(Matches(points, points), known)
    assert kept.measured.tolist() == [[400.0, 200.0]]


def test_unknown_matcher_lists_the_choices():
    assert {"aliked", "daisy", "disk", "sift"} <= {matcher.name for matcher in matchers()}
    with pytest.raises(RegistryError, match="daisy"):
        get_matcher("mast3r")


@pytest.mark.parametrize("name", ["aliked", "disk"])
def test_learned_matchers_say_what_they_miss(name, tmp_path):
    with pytest.raises(ConfigError, match="`features_model`"):
        get_matcher(name)
    with pytest.raises(InputError, match="no such file"):
        get_matcher(name, Models(tmp_path / "absent.onnx"))
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(b"not a network" * 50)
    with pytest.raises(InputError, match="ONNX"):
        get_matcher(name, Models(damaged))
    with pytest.raises(ConfigError, match="no network"):
        get_matcher("sift", Models(damaged))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Pairs, a checkpoint trained for a moment and an evaluation that kept its renderings."""
    folder = tmp_path_factory.mktemp("match")
    write_pairs(folder / "pairs.h5", make_scene(np.random.default_rng(3), pairs=24))
    config = train.Config(
        model="M2", epochs=2, batch=8, widths=(4, 8), dropout=(0.0, 0.0), device="cpu", precision="fp32"
    )
    train.run(folder / "pairs.h5", folder / "checkpoint.h5", config)
    settings = evaluate.Config(device="cpu", only=("learned", "hapke_minmax"))
    evaluate.run(folder / "pairs.h5", folder / "checkpoint.h5", folder / "evaluation.h5", settings)
    return folder


def test_match_of_pairs_and_of_kept_renderings_agree(trained):
    config = match.Config(matchers=("sift",), count=4, device="cpu")
    direct = match.run([trained / "pairs.h5", trained / "checkpoint.h5"], None, config)
    kept = match.run([trained / "evaluation.h5"], None, config)
    assert set(direct["matchers"]["sift"]) == {"learned", "hapke_minmax"}
    for name, row in direct["matchers"]["sift"].items():
        assert row["matches"] > 20
        assert row["matches"] == pytest.approx(kept["matchers"]["sift"][name]["matches"], rel=0.05)
        assert row["within_3_px_percent"] == pytest.approx(kept["matchers"]["sift"][name]["within_3_px_percent"], abs=5)


def test_match_writes_json_and_coloured_pictures(trained, tmp_path):
    files = (trained / "pairs.h5", trained / "checkpoint.h5")
    options = ("--matcher", "sift", "--count", 2, "--device", "cpu", "--figures", tmp_path / "figures")
    code, printed = run_command("match", *files, *options, "--json", tmp_path / "match.json")
    assert code == 0
    assert "within" in (tmp_path / "match.json").read_text() and "hapke_minmax" in printed
    assert json.loads((tmp_path / "match.json").read_text())["crops"] == 2
    picture = cv2.imread(str(tmp_path / "figures" / "match_sift_1.png")).astype(int)
    assert (np.ptp(picture, axis=2) > 60).sum() > 100  # coloured dots on grey pictures


def test_image_files_are_matched(texture, tmp_path):
    for name, (dx, dy) in {"measured": (0, 0), "same": (0, 0), "shifted": (4, 0)}.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), _window(texture, dx, dy))
    files = [tmp_path / f"{n}.png" for n in ("measured", "same", "shifted")]
    rows = match.run(files, None, match.Config(matchers=("sift",)))["matchers"]["sift"]
    assert rows["same"]["within_1_px_percent"] == 100
    assert rows["shifted"]["within_3_px_percent"] < 10 and rows["shifted"]["within_5_px_percent"] > 90


@pytest.mark.parametrize(
    "case", ["missing image", "other size", "not an image", "no rendering", "no checkpoint", "no renderings kept"]
)
def test_bad_input_is_one_line(trained, texture, tmp_path, case):
    first, second, text = tmp_path / "a.png", tmp_path / "b.png", tmp_path / "c.png"
    cv2.imwrite(str(first), texture)
    cv2.imwrite(str(second), texture[:200])
    text.write_text("no picture")
    if case == "no renderings kept":
        settings = evaluate.Config(device="cpu", renderings=False, only=("learned",))
        evaluate.run(trained / "pairs.h5", trained / "checkpoint.h5", tmp_path / "bare.h5", settings)
    files = {
        "missing image": [first, tmp_path / "absent.png"],
        "other size": [first, second],
        "not an image": [first, text],
        "no rendering": [first],
        "no checkpoint": [trained / "pairs.h5"],
        "no renderings kept": [tmp_path / "bare.h5"],
    }[case]
    code, message = run_command("match", *files, "--device", "cpu")
    assert code == 3 and message and "\n" not in message
