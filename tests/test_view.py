"""`lunargr view`: what the page holds, and what it refuses."""

from __future__ import annotations

import json
import re
import zlib

import h5py
import numpy as np
import pytest
from relief import hills
from render_scene import make_grid, run_lunargr, write_svbrdf

from schemas import ConfigError, LunargrError, RegistryError
from schemas.packing import read
from stages import view
from stages.physics.maps.grid import read_grid
from stages.physics.photometry import get_model, model_names
from stages.view.frames import make_frames
from stages.view.layers import read_content
from stages.view.packing import Packed, pack_map
from stages.view.photographs import read_photographs


def unpack(packed: Packed) -> np.ndarray:
    """What the page's script does, in numpy."""
    planes = (
        np.frombuffer(zlib.decompress(packed.data), np.uint8).reshape(packed.planes, *packed.shape).astype(np.int64)
    )
    folded = sum(plane << (8 * k) for k, plane in enumerate(planes))
    codes = np.where(folded & 1, -((folded + 1) >> 1), folded >> 1)
    if packed.order == 2:
        codes = np.cumsum(codes, axis=0)
    return packed.offset + packed.step * np.cumsum(codes, axis=1)


@pytest.mark.parametrize("kind", ["smooth", "noise", "constant"])
def test_a_packed_map_comes_back_to_half_a_step(rng, kind):
    values = {
        "smooth": hills(rng, 80, 5.0)[:60] - 2600.0,
        "noise": rng.normal(0.05, 0.01, (60, 80)),
        "constant": np.full((60, 80), 0.3),
    }[kind]
    known = rng.random(values.shape) > 0.1
    found = unpack(pack_map(np.where(known, values, np.nan), known, 1e-4))
    assert np.abs(found - values)[known].max() <= 0.5001e-4
    assert np.isfinite(found).all()


def test_a_map_with_an_outlier_that_three_bytes_cannot_hold_takes_a_coarser_step():
    values = np.array([[0.0, 1e9], [1.0, 2.0]])
    packed = pack_map(values, np.ones((2, 2), bool), 1e-3)
    assert packed.step > 1e-3 and packed.planes <= 4
    np.testing.assert_allclose(unpack(packed), values, atol=packed.step)


def test_content_has_every_map_of_the_file(hilly_map):
    path, grid, elevation, coefficients = hilly_map
    with h5py.File(path, "a") as file:
        deviation = file.create_dataset("coefficient_std", data=np.abs(coefficients).astype(np.float32))
        deviation.attrs["units"] = "1"
        albedo = file.create_dataset("albedo", data=np.full(elevation.shape, 1.1, np.float32))
        albedo.attrs["long_name"] = "relative to what the terrain predicts"
        counts = file.create_dataset("albedo_images", data=np.full(elevation.shape, 3, np.uint8))
        counts.attrs["long_name"] = "how many made it"
        file["coefficients_std"] = np.abs(coefficients[1:2]).astype(np.float32)  # of those that vary by place
        file["map_name"] = np.array(["b"], h5py.string_dtype())
        file["samples"] = np.arange(7)  # not a map
    content = read_content(path, 2048)
    assert content.factor == 1 and content.grid.transform == grid.transform
    np.testing.assert_array_equal(content.elevation, elevation.astype(np.float32))
    assert [layer.name for layer in content.coefficients] == ["a", "b", "c", "albedo"]  # albedo is in the picture
    expected = ["albedo_images", "b_std", *(f"coefficient_std_{k}" for k in "abc")]
    assert sorted(layer.name for layer in content.others) == expected
    titles = {layer.name: layer.title for layer in content.others}
    assert titles["albedo_images"] == "albedo images: how many made it"
    assert content.model.formula.startswith("albedo_factor (")


def test_a_large_map_is_shown_as_means_at_the_same_place(hilly_map):
    path, grid, elevation, _ = hilly_map
    content = read_content(path, 70)
    assert content.factor == 3 and content.elevation.shape == (53, 66)
    np.testing.assert_allclose(content.elevation[10, 20], elevation[30:33, 60:63].mean(), rtol=1e-6)
    np.testing.assert_allclose(content.grid.xy(10, 20), grid.xy(31, 61))
    hole = content.coefficients[0].values
    assert np.isnan(hole[8, 22]) and np.isfinite(hole[8, 35])


def test_photographs_lie_on_the_ground_that_they_show(small_artefacts, tmp_path):
    path = map_of(small_artefacts["scene"], tmp_path)
    content = read_content(path, 2048)
    frames = make_frames(content.grid)
    found = read_photographs(small_artefacts["pairs"], content.grid, 1, frames, 5)
    assert len(found) == 5
    with h5py.File(small_artefacts["pairs"]) as file:
        names = [name.decode() for name in file["image_id"][...]]
        for photograph in found:
            height, width = photograph.image.shape
            ground = content.elevation[
                photograph.row : photograph.row + height, photograph.col : photograph.col + width
            ]
            same = [k for k in range(len(file["row"])) if np.allclose(read(file["elevation"], k), ground, atol=0.02)]
            assert same, "no crop has this ground"
            pair = next(k for k in same if names[file["image_index"][k]] == photograph.title)
            sun = file["sun_direction_enu"][pair]
            assert photograph.sun_elevation_deg == pytest.approx(np.degrees(np.arcsin(sun[2])), abs=0.1)
            # the camera's height over the middle of the map, a few hundred metres away
            assert photograph.camera[2] == pytest.approx(file["camera_position_enu"][pair, 2] + ground.mean(), rel=1e-2)


def map_of(scene, folder, model="M2"):
    """A map with one reflectance over the ground of a scene."""
    with h5py.File(scene) as file:
        grid, elevation = read_grid(file, scene), file["elevation"][...]
    defaults = list(get_model(model).defaults().values())
    coefficients = np.broadcast_to(np.array(defaults)[:, None, None], (len(defaults), *elevation.shape))
    return write_svbrdf(folder / "svbrdf.h5", grid, elevation, coefficients, model)


def test_every_model_here_states_its_formula_for_the_page():
    assert [name for name in model_names() if not (get_model(name).glsl or "").count("float radiance_factor(")] == []


def test_a_model_without_a_formula_for_the_page_is_refused_with_those_that_have_one(hilly_map, tmp_path, monkeypatch):
    monkeypatch.setattr(type(get_model("M2")), "glsl", None)
    with pytest.raises(RegistryError, match=r"its model M2 has no formula for a page.*akimov.*M1, M3"):
        view.run(hilly_map[0], None, tmp_path / "o.html", view.Config())
    assert not (tmp_path / "o.html").exists()


@pytest.mark.parametrize(
    ("config", "output", "message"),
    [
        (view.Config(), "o.png", r"ends in \.html"),
        (view.Config(max_px=3), "o.html", "`max_px`"),
        (view.Config(sun_elevation_deg=0.0), "o.html", "`sun_elevation_deg`"),
        (view.Config(photographs=0), "o.html", "`photographs`"),
    ],
)
def test_options_that_make_no_page(hilly_map, tmp_path, config, output, message):
    with pytest.raises(ConfigError, match=message):
        view.run(hilly_map[0], None, tmp_path / output, config)


def test_files_that_make_no_page(hilly_map, small_artefacts, tmp_path):
    path = hilly_map[0]
    grid, empty = make_grid(20, 20, 5.0), np.full((3, 20, 20), np.nan)
    nothing = write_svbrdf(tmp_path / "empty.h5", grid, np.zeros((20, 20)), empty)
    for source, pairs, message in (
        (small_artefacts["scene"], None, "svbrdf"),
        (nothing, None, "nothing to show"),
        (path, path, "pairs"),
        (path, small_artefacts["pairs"], "this map's scene"),
    ):
        with pytest.raises(LunargrError, match=message):
            view.run(source, pairs, tmp_path / "o.html", view.Config())
    assert not list(tmp_path.glob("*.html"))


def test_the_page_asks_for_nothing_outside_itself_and_a_title_cannot_break_it(hilly_map, tmp_path):
    title = "</script><b>A & B"
    view.run(hilly_map[0], None, tmp_path / "o.html", view.Config(title=title))
    text = (tmp_path / "o.html").read_text()
    assert "default-src 'none'" in text
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)=\"(?!data:)", text)
    assert "<title>&lt;/script&gt;&lt;b&gt;A &amp; B" in text
    head = json.loads(re.search(r'id="head">(.*?)</script>', text, re.S).group(1))
    assert head["title"] == title and "</script>" not in json.dumps(head["shaders"])


def test_the_command_makes_a_page(hilly_map, tmp_path, monkeypatch, capsys):
    assert run_lunargr(monkeypatch, capsys, "view", hilly_map[0], "-o", tmp_path / "v.html")[0] == 0
    code, error = run_lunargr(monkeypatch, capsys, "view", hilly_map[0], "-o", tmp_path / "v.html")
    assert code == 3 and "--overwrite" in error and error.count("\n") == 1
