"""`lunargr render --stereo`: correspondences that are true on the ground, and splits that share none of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from relief import hills
from render_scene import lunargr_render, make_grid, smooth_maps, write_svbrdf

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
