"""`lunargr view`: what the page holds, and what it refuses."""

from __future__ import annotations

import base64
import json
import re
import zlib

import h5py
import numpy as np
import pytest
from relief import hills
from render_scene import make_grid, run_lunargr, smooth_maps, write_svbrdf

from schemas import ConfigError, LunargrError, RegistryError
from schemas.packing import read
from stages import view
from stages.physics.maps.grid import read_grid
from stages.physics.photometry import evaluate, get_model, model_names
from stages.view.frames import make_frames
from stages.view.layers import read_content
from stages.view.packing import Blob, Packed, Packer
from stages.view.page import describe
from stages.view.photographs import read_photographs


def unpack(packed: Packed, earlier: list[np.ndarray]) -> np.ndarray:
    """What the page's script does, pixel by pixel; its codes are added to ``earlier``."""
    (height, width), base = packed.shape, {1: 256, 2: 16, 3: 6}[packed.share]
    stream = np.frombuffer(zlib.decompress(packed.data), np.uint8).astype(int)
    first = -(-height * width // packed.share)
    left = (stream[:first, None] // base ** np.arange(packed.share) % base).ravel()[: height * width]
    more = stream[first:].reshape(4, -1)
    left[left == base - 1] += (more * 256 ** np.arange(4)[:, None]).sum(axis=0)
    left = np.where(left & 1, -((left + 1) >> 1), left >> 1).reshape(height, width)
    codes = np.zeros((height + 1, width + 2), int)
    for row in range(1, height + 1):
        codes[row, 0] = codes[row - 1, 1]
        for col in range(1, width + 1):
            near = [codes[row, col - 1], codes[row - 1, col], codes[row - 1, col - 1], codes[row - 1, col + 1]]
            for other in (earlier[k] for k in packed.helpers):
                near += [other[row, col], other[row, col - 1], other[row - 1, col], other[row - 1, col - 1]]
            total = sum(w * v for w, v in zip(packed.weights, [*near, 1], strict=True))
            codes[row, col] = left[row - 1, col - 1] + (total + 2048) // 4096
        codes[row, -1] = codes[row, -2]
    earlier.append(codes)
    return packed.offset + packed.step * codes[1:, 1:-1]


def test_packed_maps_come_back_to_half_a_step_and_alike_ones_help_each_other(rng):
    smooth, noise = hills(rng, 80, 5.0)[:60], rng.normal(0.05, 0.01, (60, 80))
    maps = [smooth - 2600.0, noise, np.full((60, 80), 0.3), 3 * noise + 1e-3 * smooth, noise[:20, :20]]
    maps[1][30, 40] = 800.0  # an outlier: one number of four bytes
    known = rng.random((60, 80)) > 0.1
    packer, earlier, sizes = Packer(), [], []
    for values in maps:
        good = known[: values.shape[0], : values.shape[1]]
        packed = packer.pack(np.where(good, values, np.nan), good, 1e-3)
        found = unpack(packed, earlier)
        assert np.abs(found - values)[good].max() <= 0.5001e-3
        assert np.isfinite(found).all()
        sizes.append(len(packed.data))
    alone = Packer().pack(maps[3], known, 1e-3)
    assert packer.frames[4].shape == (21, 22) and sizes[3] < len(alone.data) / 2
    assert sizes[1] < 1.1 * 60 * 80 * np.log2(4.13 * 10) / 8  # bytes of noise with so many steps


def test_a_map_with_an_outlier_that_its_codes_cannot_hold_takes_a_coarser_step():
    values = np.array([[0.0, 1e9], [1.0, 2.0]])
    packed = Packer().pack(values, np.ones((2, 2), bool), 1e-3)
    assert packed.step > 1e-3
    np.testing.assert_allclose(unpack(packed, []), values, atol=packed.step)


@pytest.mark.parametrize("model", ["M2", "kernels"])
def test_coefficients_are_kept_as_finely_as_the_page_says(tmp_path, rng, model):
    defaults = np.array(list(get_model(model).defaults().values()))
    relative = 4 * (smooth_maps(rng, (60, 80), len(defaults)) - 0.05)
    coefficients = (defaults[:, None, None] * (1 + relative)).astype(np.float32)
    grid = make_grid(60, 80, 5.0)
    path = write_svbrdf(tmp_path / "m.h5", grid, hills(rng, 80, 5.0)[:60], coefficients, model)
    content, blob = read_content(path, 2048), Blob()
    head = describe(content, make_frames(content.grid), [], blob)
    data, earlier = base64.b64decode(blob.text()), []

    def values_of(entry):
        start, length = entry["data"]
        return unpack(
            Packed(**{**entry, "data": data[start : start + length], "shape": tuple(entry["shape"])}), earlier
        )

    values_of(head["elevation"])
    kept = []
    for field, given in zip(head["fields"], coefficients, strict=True):
        kept.append(values_of(field["map"]) if "map" in field else np.full_like(given, field["constant"]))
        spread = np.subtract(*np.percentile(given, (99, 1)))
        assert np.abs(kept[-1] - given).max() <= 0.51 * spread / head["levels"]
    names = [p.name for p in get_model(model).parameters]
    exact, shown = (
        evaluate(model, dict(zip(names, maps, strict=True)), *np.radians([50.0, 20.0, 40.0]))
        for maps in (coefficients.astype(float), kept)
    )
    error = np.sqrt(np.mean((shown - exact) ** 2)) / exact.mean()
    assert 0.2 * head["error"] < error < 2 * head["error"] <= 2e-3


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
