"""`lunargr render --stereo`: correspondences that are true on the ground, and splits that share none of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from relief import hills
from render_scene import SUN, lunargr_render, make_grid, smooth_maps, write_svbrdf

from stages.render.pictures import read_exr


@pytest.fixture
def wide_map(rng, tmp_path):
    grid = make_grid(240, 240, 10.0)
    return write_svbrdf(tmp_path / "svbrdf.h5", grid, 0.5 * hills(rng, 240, 10.0), smooth_maps(rng, (240, 240)))


def test_matching_pixels_show_the_same_ground(wide_map, tmp_path, monkeypatch, capsys):
    arguments = (
        "--stereo",
        "3",
        "--size",
        "64,64",
        "--fov",
        "10",
        "--convergence",
        "10,20",
        "-o",
        tmp_path / "s",
        "-q",
    )
    code, error = lunargr_render(monkeypatch, capsys, wide_map, *arguments)
    assert code == 0, error
    manifest = json.loads((tmp_path / "s" / "manifest.json").read_text())
    assert len(manifest["pairs"]) == 3
    for pair in manifest["pairs"]:
        left, right = (read_exr(tmp_path / "s" / pair[side]["image"]) for side in ("left", "right"))
        matches = read_exr(tmp_path / "s" / pair["matches"])
        sure = matches["visible"] == 1
        assert sure.mean() > 0.4 and pair["overlap"] == pytest.approx(sure[np.isfinite(left["depth"])].mean(), abs=1e-6)
        line, sample = matches["line"][sure].astype(int), matches["sample"][sure].astype(int)
        away = np.hypot(
            left["longitude_deg"][sure] - right["longitude_deg"][line, sample],
            left["latitude_deg"][sure] - right["latitude_deg"][line, sample],
        )
        # 1 degree is 30 km on the Moon: within a pixel's ground of each other
        assert np.median(away) * 30_323 < manifest["gsd"]
        assert 10 <= pair["convergence_deg"] <= 20
        places = [np.array(pair[side]["camera"]["position_mcmf"]) for side in ("left", "right")]
        assert pair["baseline"] == pytest.approx(np.linalg.norm(places[0] - places[1]))
        assert pair["left"]["sun_azimuth_deg"] != pair["right"]["sun_azimuth_deg"]


def test_no_ground_is_seen_in_two_splits(wide_map, tmp_path, monkeypatch, capsys):
    arguments = ("--stereo", "12", "--size", "24,24", "--fov", "10", "--altitude", "1200", "-o", tmp_path / "s", "-q")
    assert lunargr_render(monkeypatch, capsys, wide_map, *arguments)[0] == 0
    manifest = json.loads((tmp_path / "s" / "manifest.json").read_text())
    seen: dict[str, list[np.ndarray]] = {}
    for pair in manifest["pairs"]:
        for side in ("left", "right"):
            planes = read_exr(tmp_path / "s" / pair[side]["image"])
            known = np.isfinite(planes["depth"])
            cells = np.stack([planes["longitude_deg"][known], planes["latitude_deg"][known]]) * 3000  # of 10 m
            seen.setdefault(pair["split"], []).append(np.unique(np.rint(cells).astype(int), axis=1))
    ground = {split: {tuple(c) for part in parts for c in part.T} for split, parts in seen.items()}
    assert len(ground) >= 2 and "train" in ground
    for split, cells in ground.items():
        for other, others in ground.items():
            assert split == other or not cells & others


def test_bad_stereo_options_are_one_line(wide_map, tmp_path, monkeypatch, capsys):
    for arguments, message in (
        (("--stereo", "0"), "--stereo"),
        (("--stereo", "2", "--convergence", "20,10"), "--convergence"),
        (("--stereo", "2", "--sun-azimuth", "10", "--sun-elevation", "10"), "no Sun"),
        (("--stereo", "2", "--altitude", "90000"), "lower --altitude"),
        (("--stereo", "2", "--shard", "1/2"), "--shard"),
    ):
        code, error = lunargr_render(monkeypatch, capsys, wide_map, *arguments, "-o", tmp_path / "s")
        assert code == 3 and message in error and error.count("\n") == 1, error


def test_stereo_pairs_replace_no_file_unless_told_to(wide_map, tmp_path, monkeypatch, capsys):
    own = tmp_path / "s" / "pair_00001_matches.exr"
    own.parent.mkdir()
    own.write_text("somebody's own")
    arguments = ("--stereo", "3", "--size", "16,16", "--fov", "10", "-o", tmp_path / "s", "-q")
    code, error = lunargr_render(monkeypatch, capsys, wide_map, *arguments)
    assert code == 3 and "pair_00001_matches.exr: exists already" in error
    assert list(own.parent.iterdir()) == [own] and own.read_text() == "somebody's own"
    assert lunargr_render(monkeypatch, capsys, wide_map, *arguments, "--overwrite")[0] == 0
    assert len(list(own.parent.iterdir())) == 3 * 5 + 1


def test_a_rig_has_two_parallel_cameras_under_one_sun(wide_map, tmp_path, monkeypatch, capsys):
    """Over level ground a disparity is focal length x baseline / depth."""
    size = ("--size", "64,64", "--fov", "10", "--rig", "30", "-q")
    code, error = lunargr_render(monkeypatch, capsys, wide_map, "--stereo", "3", *size, "-o", tmp_path / "s")
    assert code == 0, error
    for pair in json.loads((tmp_path / "s" / "manifest.json").read_text())["pairs"]:
        left, right = pair["left"]["camera"], pair["right"]["camera"]
        assert left["rotation_camera_to_mcmf"] == right["rotation_camera_to_mcmf"]
        assert pair["baseline"] == pytest.approx(30.0)
        assert pair["left"]["sun_azimuth_deg"] == pair["right"]["sun_azimuth_deg"]
        matches, depth = (read_exr(tmp_path / "s" / name) for name in (pair["matches"], pair["left"]["image"]))
        line, sample = np.indices(depth["depth"].shape) + 0.5
        focal = left["focal_px"][0]
        along = depth["depth"] / np.sqrt(1 + ((line - 32) ** 2 + (sample - 32) ** 2) / focal**2)
        np.testing.assert_allclose(sample - matches["sample"], focal * 30.0 / along, atol=1e-3)
        np.testing.assert_allclose(matches["line"], line, atol=1e-3)


def test_a_trajectory_on_a_rig_has_two_views_a_row(wide_map, tmp_path, monkeypatch, capsys):
    (tmp_path / "t.csv").write_text("view_id,longitude_deg,latitude_deg,altitude_m\na,-42,17,3000\nb,-42,17,2000\n")
    view = ("--trajectory", tmp_path / "t.csv", "--rig", "0.5", "--size", "24,24", "--fov", "5", *SUN, "-q")
    for shard in ("1/2", "2/2"):
        code, error = lunargr_render(monkeypatch, capsys, wide_map, *view, "-o", tmp_path / "v", "--shard", shard)
        assert code == 0, error
    code, error = lunargr_render(monkeypatch, capsys, wide_map, *view, "-o", tmp_path / "v", "--resume")
    assert code == 0, error
    views = json.loads((tmp_path / "v" / "cameras.json").read_text())["views"]
    assert [v["view_id"] for v in views] == ["a_left", "a_right", "b_left", "b_right"]
    apart = np.subtract(views[1]["position_mcmf"], views[0]["position_mcmf"])
    np.testing.assert_allclose(apart, 0.5 * np.array(views[0]["rotation_camera_to_mcmf"])[:, 0], atol=1e-6)
    assert len(list((tmp_path / "v").glob("*.exr"))) == 4


@pytest.mark.parametrize(
    "arguments",
    [
        ("--rig", "0.5", "--position", "-42,17,3000"),
        ("--rig", "-1", "--stereo", "1"),
        ("--rig", "1", "--stereo", "1", "--convergence", "5,6"),
    ],
)
def test_a_rig_that_cannot_be_is_refused(wide_map, tmp_path, monkeypatch, capsys, arguments):
    sun = SUN if "--position" in arguments else ()
    code, error = lunargr_render(monkeypatch, capsys, wide_map, *arguments, *sun, "-o", tmp_path / "x")
    assert code == 3 and "--rig" in error and error.count("\n") == 1
