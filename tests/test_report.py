"""The report is one file, complete, valid and true to the numbers it was given."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
from html.parser import HTMLParser

import cv2
import h5py
import numpy as np
import pytest
from evaluation_scene import make_scene, run_command, write_pairs

from schemas import DIAGNOSIS, SCENE, SVBRDF, ArtefactWriter
from schemas.files.outputs import Output
from stages import evaluate, match, report, train
from stages.report import conclusions
from stages.report.maps import _longest, round_length

WKT = "LOCAL_CS[moon]"
VOID = {"meta", "img", "br", "link", "hr", "input"}


def _write_maps(folder, rng):
    """A scene and its coefficient maps with a hole in the DEM."""
    elevation = cv2.GaussianBlur(rng.normal(size=(90, 140)), (0, 0), 6).astype(np.float32) * 900
    valid = np.ones(elevation.shape, bool)
    valid[10:30, 20:50] = False
    place = {"gsd_m": 5.0, "body_radius_m": 1737400.0}
    grid = {"y": np.arange(90)[::-1] * 5.0, "x": np.arange(140) * 5.0}
    sizes = {"frame": 2, "y": 90, "x": 140, "window": 4}
    more = {"crop_px": 32, "elevation_source": "dem.tif"}
    with ArtefactWriter(folder / "scene.h5", SCENE, sizes, attributes=place | more, seed=0) as out:
        for name, values in grid.items():
            out.write(name, values)
        out.write_crs(WKT, (5, 0, 0, 0, -5, 450))
        out.write("elevation", np.where(valid, elevation, np.nan))
        out.write("dem_valid", valid)
        out.write("valid", np.stack([valid, valid & (np.arange(140) < 70)]))
        out.write("frame_window", np.tile([0, 0, 90, 140], (2, 1)))
        out.write("valid_area_m2", [1e6, 2e6])
        out.write("image_id", ["first", "<second>"])
        for name in ("path", "camera", "start_time"):
            out.write(name, ["", ""])
        out.write("units", [0, 0])
        for name in SCENE.variables:
            if name.name.startswith(("subsolar", "spacecraft", "solar_distance")):
                out.write(name.name, [1.0, 2.0])
    sizes = {"coefficient": 3, "y": 90, "x": 140}
    more = {"model": "M2", "quantity": "I/F"}
    with ArtefactWriter(folder / "svbrdf.h5", SVBRDF, sizes, attributes=place | more, seed=0) as out:
        for name, values in grid.items():
            out.write(name, values)
        out.write_crs(WKT, (5, 0, 0, 0, -5, 450))
        out.write("coefficients", np.where(valid, np.stack([elevation * s + s for s in (1, 2, 3)]), np.nan))
        out.write("coefficient_name", ["a", "b", "c"])
        out.write("elevation", elevation)
        out.write("valid", valid)


FOUND = {
    "verdict": "named",
    "causes": [
        {
            "effect": "sun_elevation",
            "parameters": {"error_deg": {"value": 1.25, "error": 0.1, "unit": "degree"}},
            "p_family_wise": 0.002,
            "gain_nats": 321.0,
            "gain_error": 9.0,
            "residual_rms_before": 0.01,
            "residual_rms_after": 0.008,
            "group": ["sun_elevation"],
            "to_separate": "",
        }
    ],
    "unexplained_fraction": 0.1,
    "blind": ["earthshine"],
    "held_out": {"mse_nominal": 1, "mse_extended": 0.9, "gain_percent": 10.0, "gain_percent_low": 8.0, "gain_percent_high": 12.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One file of every kind that the report shows."""
    folder = tmp_path_factory.mktemp("report")
    rng = np.random.default_rng(4)
    write_pairs(folder / "pairs.h5", make_scene(rng, pairs=24))
    config = train.Config(
        model="M2", epochs=2, batch=8, widths=(4, 8), dropout=(0.0, 0.0), device="cpu", precision="fp32"
    )
    train.run(folder / "pairs.h5", folder / "checkpoint.h5", config)
    files = (folder / "pairs.h5", folder / "checkpoint.h5")
    evaluate.run(*files, folder / "evaluation.h5", evaluate.Config(device="cpu"))
    settings = match.Config(("sift",), count=2, device="cpu")
    match.run(list(files), Output(folder / "match.json", figures=folder), settings)
    _write_maps(folder, rng)
    extra = {"report": json.dumps(FOUND), "extension": "[]"}
    with ArtefactWriter(folder / "diagnosis.h5", DIAGNOSIS, {"frame": 1}, attributes=extra, seed=0) as out:
        out.write("image_id", ["first"])
    return folder


class Outline(HTMLParser):
    """Checks that tags are balanced and collects what the page refers to."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.sources, self.tags = [], [], [], set()

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href"):
                self.sources.append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def page(folder):
    files = [*folder.glob("*.h5"), *folder.glob("*.json"), *folder.glob("*.png")]
    titles = report.run(files, folder / "report.html", report.Config("A <title> & more"))
    return (folder / "report.html").read_text(), titles


def test_the_page_needs_nothing_else(page):
    text, _ = page
    outline = Outline()
    outline.feed(text)
    assert not outline.open
    assert len(outline.ids) == len(set(outline.ids)) > 10
    for source in outline.sources:
        assert source.startswith("data:") or (source.startswith("#") and source[1:] in outline.ids), source[:80]
    assert outline.tags.isdisjoint({"script", "link", "iframe", "object"})
    assert "http" not in re.sub(r"data:[^\"]*", "", text)
    assert "prefers-color-scheme: dark" in text


def test_every_picture_shows_something(page):
    pictures = re.findall(r'src="data:image/(?:png|webp);base64,([^"]+)"', page[0])
    assert len(pictures) > 3 + 8 + 3 * 17
    for content in pictures:
        image = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_UNCHANGED)
        assert image is not None and image.std() > 1


def test_all_parts_are_there_in_order(page):
    assert page[1] == [
        "Terrain and images", "Pairs of terrain and image", "Training", "Reflectance maps",
        "Evaluation on unseen ground", "Feature matching", "Diagnosis", "Pictures", "Provenance",
    ]  # fmt: skip


def test_numbers_are_those_of_the_files(page, folder):
    text = page[0]
    result = json.loads((folder / "evaluation.json").read_text())
    for row in result["models"].values():
        assert f"{row['mse']:.3e}" in text and f"{row['ssim']:.3f}" in text
    gain = result["gains"]["learned_gain_offset"]["hapke_gain_offset"]["gain_percent"]
    assert f"{gain:+.1f}" in text
    matching = json.loads((folder / "match.json").read_text())["matchers"]["sift"]["learned"]
    assert f"{matching['within_3_px_percent']:.1f}" in text
    assert "sun elevation" in text and "1.25\u00a0+-\u00a00.1\u00a0degree" in text and "earthshine" in text


def test_text_of_the_user_is_escaped(page):
    assert "A &lt;title&gt; &amp; more" in page[0] and "&lt;second&gt;" in page[0] and "<second>" not in page[0]


def test_the_hole_in_the_dem_stays_a_hole(folder):
    from stages.common.page.pictures import coloured, shaded_relief

    elevation = np.linspace(0, 50, 400).reshape(20, 20)
    elevation[3:6, 3:6] = np.nan
    for picture in (shaded_relief(elevation, 5.0)[0], coloured(elevation, 0, 50, "magma")):
        assert (picture[..., 3] == 0).sum() == 9 and (picture[0, 0, 3], picture[4, 4, 3]) == (255, 0)


def test_the_hillshade_is_lit_from_the_upper_left():
    from stages.common.page.pictures import shaded_relief

    rows, cols = np.mgrid[:60, :60]
    cone = 30.0 - np.hypot(rows - 29.5, cols - 29.5)
    picture = shaded_relief(cone, 1.0)[0][..., :3].sum(axis=2).astype(float)
    assert picture[15:25, 15:25].mean() > 1.3 * picture[35:45, 35:45].mean()


def test_large_maps_are_thinned(tmp_path):
    import h5py

    from stages.common.page.pictures import read_thinned

    with h5py.File(tmp_path / "map.h5", "w") as file:
        file["map"] = np.add.outer(np.arange(2000.0), np.zeros(150))
        small, step = read_thinned(file["map"], longest=900)
    assert step == 3 and small.shape == (667, 50) and np.array_equal(small[:, 0], np.arange(0, 2000, 3))


def _said(text):
    """The sentences of the first screen: (class, text)."""
    found = re.search(r'<ul class="conclusions">(.*?)</ul>', text, re.S)
    return re.findall(r'<li(?: class="(\w+)")?>(.*?)</li>', html.unescape(found[1])) if found else []


def test_the_first_screen_concludes_before_anything_else(page):
    sentences = [text for _, text in _said(page[0])]
    assert sentences[0].startswith("Learned from heights and") and "a, b and c of the model M2" in sentences[0]
    assert any(s.startswith("On unseen ground") and "1 training run" in s for s in sentences)
    assert "The simulation lacks sun elevation." in sentences[-3] and "earthshine" in sentences[-1]
    assert page[0].index('class="conclusions"') < page[0].index("<nav>")


def test_the_first_screen_shows_numbers_and_one_crop_before_and_after(page, folder):
    """Three numbers with their intervals, signed as changes of an error; the slider's pictures are the renderings of one crop."""
    first, _ = page[0].split("<nav>")
    result = json.loads((folder / "evaluation.json").read_text())
    gain = result["gains"]["learned"][result["strongest_baseline"]["none"]]
    assert re.findall(r'<dd class="value">(.*?)</dd>', first)[:2] == [f"{-gain['gain_percent']:+.1f} %", "1.25 deg"]
    assert first.count('<dd class="value">') == 3 and "95 %: 1.05 .. 1.45 deg" in first
    assert (
        first.index("headline")
        < first.index('class="slider"')
        < first.index("<details")
        < first.index('class="conclusions"')
    )
    right, left = (decoded(code) for code in re.findall(r'base64,([^"]+)"', first[first.index('class="slider"') :])[:2])
    with h5py.File(folder / "evaluation.h5") as file:
        names = [name.decode() for name in file["model_name"][...]]
        shown = [file["rendered"][names.index(name)] for name in (result["strongest_baseline"]["none"], "learned")]
    agree = [
        [np.corrcoef(picture.ravel(), crop.ravel())[0, 1] for crop in crops]
        for picture, crops in zip((left, right), shown, strict=True)
    ]
    assert min(map(max, agree)) > 0.99 and np.argmax(agree[0]) == np.argmax(agree[1])


def decoded(code: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_GRAYSCALE)


def test_a_note_stands_above_the_results(tmp_path):
    (tmp_path / "diagnosis.json").write_text(json.dumps(FOUND))
    report.run([tmp_path / "diagnosis.json"], tmp_path / "page.html", report.Config(note="One <run>."))
    text = (tmp_path / "page.html").read_text()
    assert text.index("One &lt;run&gt;.") < text.index('class="headline"')


@pytest.mark.parametrize(
    ("low", "high", "value", "interval", "kind"),
    [(3.0, 20.0, "-12.0 %", "95 %: -20.0 .. -3.0 %", "good"), (-30.0, -2.0, "+12.0 %", "95 %: +2.0 .. +30.0 %", "bad"),
     (-1.0, 25.0, "-12.0 %", "95 %: -25.0 .. +1.0 %", ""), (None, None, "-12.0 %", "no interval", ""),
     (30.0, 115.0, "-12.0 %", "95 %: -100.0 .. -30.0 %", "good")],
)  # fmt: skip
def test_a_number_says_whether_it_is_sure(low, high, value, interval, kind):
    [number] = conclusions.evaluation_numbers(evaluation_result(low, high))
    assert number[:2] == (value, interval) and number.kind == kind
    assert ("not surely different" in number.label) == (not kind)


def evaluation_result(low, high):
    gain = {
        "gain_percent": -12.0 if high is not None and high < 0 else 12.0,
        "gain_percent_low": low,
        "gain_percent_high": high,
    }
    return {
        "gains": {"learned": {"kernels": gain}}, "strongest_baseline": {"none": "kernels"}, "titles": {"kernels": "Kernels"},
        "pairs": 1234, "tiles": 21, "training_runs": 3, "interval_unit": "tile",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("low", "high", "kind", "words"),
    [
        (3.0, 20.0, "good", "12.0 % lower than"),
        (-30.0, -2.0, "bad", "12.0 % higher than"),
        (-1.0, 25.0, "", "shows no sure difference from"),
        (None, None, "", "cannot be compared with"),
    ],
)
def test_a_sentence_says_what_its_interval_allows(low, high, kind, words):
    [(text, found)] = conclusions.evaluation(evaluation_result(low, high))
    assert found == kind and words in text and "'Kernels'" in text
    assert "1,234 pairs on 21 ground tiles, 3 training runs" in text


HELD_OUT = {
    "claim": "seen ground, unseen images", "image_units": "iof", "pairs": 40, "tiles": 6, "interval_unit": "tile",
    "models": {
        "terrain": {"mse": 3.1e-5, "mse_low": 2e-5, "mse_high": 5e-5, "ssim": 0.8},
        "albedo": {"mse": 4.2e-6, "mse_low": 3e-6, "mse_high": None, "ssim": None},
    },
    "gains": {"albedo": {"terrain": {"gain_percent": 86.4, "gain_percent_low": 80.0, "gain_percent_high": 90.0}}},
    "nearest_used_sun_deg": {"least": 1.2, "mean": 4.0, "most": 9.0},
    "coverage_percent": {"68": 67.1, "95": 94.9,
                         "by_incidence": [{"incidence_low_deg": 0, "incidence_high_deg": 30, "68": None, "95": 91.5}]},
    "images": [{"image_id": "seventh", "crops": 40, "nearest_used_sun_deg": 4.0, "mse_terrain": 3.1e-5, "mse_albedo": 4.2e-6}],
}  # fmt: skip


def test_unseen_images_are_a_section_of_their_own(tmp_path):
    (tmp_path / "held_out.json").write_text(json.dumps(HELD_OUT))
    assert report.run([tmp_path / "held_out.json"], tmp_path / "page.html", report.Config()) == [
        "Albedo, judged by unseen images"
    ]
    text = (tmp_path / "page.html").read_text()
    [(kind, sentence)] = _said(text)
    assert kind == "good" and "86.4 % lower than the map from terrain alone" in sentence
    assert sentence.startswith("Another claim") and "1 to 9 deg" in sentence and "1 unseen image, 40 pairs" in sentence
    assert "seventh" in text and "4.200e-06" in text and "94.9" in text and "91.5" in text


def test_a_diagnosis_shows_its_budget_and_what_got_no_name(tmp_path):
    more = {
        "budget": {"named": 0.5, "common_to_images": 0.25, "own_to_image": 0.2, "noise": 0.05},
        "rejected": [{"effect": "psf_blur", "gain_nats": 21.0, "why": "its gain may be negative."}],
        "sentence": "The simulation lacks elevation of the Sun.", "data": {"pairs": 320, "sites": 20, "images": 16},
    }  # fmt: skip
    (tmp_path / "diagnosis.json").write_text(json.dumps(FOUND | more))
    report.run([tmp_path / "diagnosis.json"], tmp_path / "page.html", report.Config())
    text = (tmp_path / "page.html").read_text()
    assert "320 pairs of 20 places: The simulation lacks elevation of the Sun." in _said(text)[0][1]
    assert _said(text)[1][0] == "good" and "10.0 % lower" in _said(text)[1][1]
    assert "own to each image" in text and "20.0" in text and "psf blur" in text and "its gain may be negative." in text


def test_a_verdict_alone_is_enough(tmp_path):
    (tmp_path / "diagnosis.json").write_text('{"verdict": "cannot_tell"}')
    report.run([tmp_path / "diagnosis.json"], tmp_path / "page.html", report.Config())
    assert _said((tmp_path / "page.html").read_text()) == [
        ("", "These data cannot tell whether something is missing from the simulation.")
    ]


def test_maps_carry_formula_scale_and_north(page):
    text = html.unescape(page[0])
    assert "I/F = a cos(i)" in text and text.count("N \u2191") == 3
    width = re.findall(r'class="length" style="width: ([\d.]+)%">([^<]+)<', page[0])[0]
    assert width[1] == "100 m" and float(width[0]) == pytest.approx(100 * 100 / (140 * 5), abs=0.01)


@pytest.mark.parametrize(("longest", "length"), [(700, 500), (1999, 1000), (2000, 2000), (0.51, 0.5), (9.9, 5)])
def test_scale_bars_have_round_lengths(longest, length):
    assert round_length(longest) == pytest.approx(length)


def test_albedo_and_its_deviation_are_shown(folder, tmp_path):
    rng = np.random.default_rng(1)
    shutil.copy(folder / "svbrdf.h5", tmp_path / "map.h5")
    with h5py.File(tmp_path / "map.h5", "a") as file:
        for name, values in (("albedo", rng.normal(1, 0.1, (90, 140))), ("albedo_std", rng.uniform(0, 0.1, (90, 140)))):
            file[name] = values.astype(np.float32)
        file["albedo_image_id"] = np.array(["one", "two"], dtype=h5py.string_dtype())
    report.run([tmp_path / "map.h5"], tmp_path / "page.html", report.Config())
    text = (tmp_path / "page.html").read_text()
    assert "Albedo from photographs" in text and "Standard deviation of the albedo" in text
    assert "albedo from 2 photographs" in _said(text)[0][1] and text.count("N &#8593;") == 5


def test_a_page_of_view_is_linked_given_or_beside(folder, tmp_path):
    for name in ("sub", "out"):
        (tmp_path / name).mkdir()
    given = tmp_path / "sub" / "a map.html"
    given.write_text("page")
    report.run([folder / "match.json", given], tmp_path / "out" / "report.html", report.Config())
    assert '<a href="../sub/a%20map.html">' in (tmp_path / "out" / "report.html").read_text()
    (tmp_path / "out" / "view.html").write_text("page")
    report.run([folder / "match.json"], Output(tmp_path / "out" / "report.html", overwrite=True), report.Config())
    assert '<a href="view.html">' in (tmp_path / "out" / "report.html").read_text()


def test_the_rendered_map_stands_on_the_first_screen_and_not_once_more(folder, tmp_path):
    """Below it the way to the page that relights the map, then the conclusions."""
    for name in ("render", "errors"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((40, 40), 90, np.uint8))
    (tmp_path / "view.html").write_text("page")
    files = [folder / "checkpoint.h5", tmp_path / "errors.png", tmp_path / "render.png", tmp_path / "view.html"]
    titles = report.run(files, tmp_path / "page.html", report.Config())
    text = (tmp_path / "page.html").read_text()
    first, rest = text.split("<nav>")
    assert first.index("The map as") < first.index("view.html") < first.index('class="conclusions"')
    assert "The map as" not in rest and "Errors of the compared models" in rest and "Pictures" in titles


def test_heavy_pictures_are_made_light_and_say_what_they_show(folder, tmp_path):
    picture = np.random.default_rng(0).integers(0, 255, (900, 2100, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "match_sift_1.png"), cv2.GaussianBlur(picture, (0, 0), 3))
    report.run([tmp_path / "match_sift_1.png"], tmp_path / "page.html", report.Config())
    text = (tmp_path / "page.html").read_text()
    [content] = re.findall(r'src="data:image/webp;base64,([^"]+)"', text)
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (600, 1400, 3) and len(text) < (tmp_path / "match_sift_1.png").stat().st_size
    assert "Matches between a measured crop" in text


@pytest.mark.parametrize("case", ["missing", "other json", "not a picture", "existing output", "nothing to show"])
def test_bad_input_is_one_line_and_leaves_nothing(folder, tmp_path, case):
    (tmp_path / "other.json").write_text('{"a": 1}')
    (tmp_path / "false.png").write_text("no picture")
    output = tmp_path / "out.html"
    files = {
        "missing": tmp_path / "absent.h5",
        "other json": tmp_path / "other.json",
        "not a picture": tmp_path / "false.png",
        "existing output": folder / "match.json",
        "nothing to show": folder / "absent.json",
    }
    if case == "existing output":
        output.write_text("mine")
    before = sorted(tmp_path.iterdir())
    code, message = run_command("report", files[case], "-o", output)
    assert code == 3 and message and "\n" not in message
    assert sorted(tmp_path.iterdir()) == before


def test_more_maps_are_shown_smaller(tmp_path):
    """The page stays light: many maps have together the pixels of a few."""
    pixels = []
    for count in (3, 12, 40):
        with h5py.File(tmp_path / f"{count}.h5", "w") as file:
            file["coefficients"] = file["coefficients_std"] = np.zeros((count, 1, 1))
            pixels.append(2 * count * _longest(file) ** 2)
    assert pixels[0] == 6 * 800**2 and pixels[1:] == pytest.approx([10 * 800**2] * 2, rel=0.01)
