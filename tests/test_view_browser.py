"""The page of `lunargr view` in a real headless Chromium, its pixels against `lunargr render`."""

from __future__ import annotations

import json
import re

import h5py
import numpy as np
import pytest
from browser import chromium, read_dom, run_in_page
from relief import hills
from render_scene import LAT, LON, make_grid, smooth_maps, write_svbrdf

from schemas.files.outputs import Output
from stages import render, view
from stages.physics.maps.grid import read_grid, unit_vectors
from stages.physics.photometry import evaluate, get_model, model_names
from stages.render.pictures import read_exr
from stages.view.frames import make_frames
from stages.view.layers import read_content
from stages.view.photographs import read_photographs

SUNS = ((270.0, 25.0), (80.0, 6.0), (200.0, 12.0), (40.0, 45.0), (330.0, 75.0))
FAMILIES = ("M2", "hapke", "lunar_lambert", "kernels")
SLOW = ("M2", "lunar_lambert")  # every formula is compared below


@pytest.fixture(scope="module", autouse=True)
def browser():
    return chromium()


def make_map(folder, model: str):
    """A steep map with craters' worth of shadow, a hole, and coefficients that vary about their defaults."""
    rng = np.random.default_rng(7)
    grid, elevation = make_grid(96, 128, 20.0), 2.0 * hills(rng, 128, 20.0)[:96]
    defaults = np.array(list(get_model(model).defaults().values()))
    vary = 1 + 4 * (smooth_maps(rng, (96, 128), len(defaults)) - 0.05)
    coefficients = (defaults[:, None, None] * vary).astype(np.float32)
    if model == "hapke":
        coefficients[2] = 0.3  # one number for the whole map
    coefficients[:, 20:30, 40:60] = np.nan
    return write_svbrdf(folder / f"{model}.h5", grid, elevation, coefficients, model)


def rendered(path, folder, **config):
    render.run(path, Output(folder / "r.exr", overwrite=True), render.Config(**config))
    image = read_exr(folder / "r.exr")["image"]
    return np.where(np.isfinite(image), np.maximum(image, 0), np.nan)


@pytest.mark.parametrize("model", [pytest.param(m, marks=[pytest.mark.slow] if m in SLOW else []) for m in FAMILIES])
def test_the_page_shows_what_render_gives(tmp_path, model):
    path, page = make_map(tmp_path, model), tmp_path / "v.html"
    view.run(path, None, page, view.Config())
    calls = ",".join(f"lunargr.pixels({{azimuth: {a}, elevation: {e}}})" for a, e in SUNS)
    for (azimuth, elevation), found in zip(SUNS, run_in_page(page, f"return [{calls}]"), strict=True):
        expected = rendered(path, tmp_path, sun_azimuth_deg=azimuth, sun_elevation_deg=elevation)
        found = found.reshape(expected.shape)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
        assert np.nanmean(found) == pytest.approx(np.nanmean(expected), rel=0.01)
        # pixel for pixel but for the soft edges of shadows
        assert np.nanquantile(np.abs(found - expected), 0.9) < 0.002 * np.nanmean(expected)
    assert np.nanmin(expected) < 0.9 * np.nanmax(expected)


@pytest.mark.parametrize("model", ["hapke", pytest.param("kernels", marks=pytest.mark.slow)])
def test_albedo_from_photographs_is_in_the_picture(tmp_path, model):
    """As `lunargr render` has it: a factor on the I/F of the coefficients, place by place."""
    path, page = make_map(tmp_path, model), tmp_path / "v.html"
    albedo = 1 + 0.5 * np.sin(np.arange(96)[:, None] / 9) * np.cos(np.arange(128) / 7)
    with h5py.File(path, "r+") as file:
        file["albedo"] = albedo.astype(np.float32)
    view.run(path, None, page, view.Config())
    calls = "return [lunargr.pixels({azimuth: 270, elevation: 35}), lunargr.head.fields.map((l) => l.name)]"
    found, layers = run_in_page(page, calls)
    expected = rendered(path, tmp_path, sun_azimuth_deg=270.0, sun_elevation_deg=35.0)
    found = found.reshape(expected.shape)
    assert np.nanmean(found) == pytest.approx(np.nanmean(expected), rel=0.01)
    assert np.nanquantile(np.abs(found - expected), 0.9) < 0.005 * np.nanmean(expected)
    assert layers.count("albedo") == 1


def test_light_that_goes_to_a_camera(tmp_path):
    path, page = make_map(tmp_path, "hapke"), tmp_path / "v.html"
    view.run(path, None, page, view.Config())
    config = {"sun_azimuth_deg": 120.0, "sun_elevation_deg": 30.0, "shadows": False}
    # 2 km up over the middle of the map, where the page's axes begin: straight above it, 45 degrees at its border
    expected = rendered(path, tmp_path, position=(LON, LAT, 2000.0), **config)
    script = "return lunargr.pixels({azimuth: 120, elevation: 30, shadows: false, camera: [0, 0, 2000]})"
    found = run_in_page(page, script).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=2e-4)
    above = rendered(path, tmp_path, **config)
    assert np.nanmax(np.abs(above - expected)) > 0.05 * np.nanmean(above)


def test_values_layers_and_the_address(tmp_path):
    path, page = make_map(tmp_path, "M2"), tmp_path / "v.html"
    with h5py.File(path, "a") as file:
        grid_shape = file["elevation"].shape
        file["coefficient_std"] = np.full((3, *grid_shape), 0.002, np.float32)
        file["coefficient_std"][:2, :40] = 0.001
        elevation, a = file["elevation"][70, 100], file["coefficients"][0, 70, 100]
    view.run(path, None, page, view.Config(sun_azimuth_deg=100.0, sun_elevation_deg=20.0))
    found = run_in_page(
        page,
        """
        const values = Object.fromEntries(lunargr.values(70, 100)), before = lunargr.state.azimuth;
        document.body.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight", bubbles: true}));
        lunargr.set({layer: "coefficient_std_b"});
        const title = document.getElementById("layer-title").textContent, limits = [...lunargr.state.limits];
        const canvas = document.getElementById("canvas");
        const place = lunargr.pick(canvas.clientWidth / 2, canvas.clientHeight / 2);
        lunargr.set({view: "space"});
        const near = lunargr.pick(canvas.clientWidth / 2, canvas.clientHeight / 2);
        await new Promise((done) => setTimeout(done, 400));
        return {values, turned: lunargr.state.azimuth - before, title, limits, place, near, address: location.hash,
          shown: getComputedStyle(document.getElementById("fallback")).display, rate: lunargr.rate(3)};
        """,
    )
    grid = make_grid(96, 128, 20.0)
    lon, lat = (float(v) for v in grid.lonlat(70, 100))
    assert float(found["values"]["Longitude"].rstrip("° E")) == pytest.approx(lon % 360, abs=2e-5)
    assert float(found["values"]["Latitude"].rstrip("° N")) == pytest.approx(lat, abs=2e-5)
    assert float(found["values"]["Height"].rstrip(" m")) == pytest.approx(elevation, abs=0.1)
    assert float(found["values"]["a"]) == pytest.approx(a, rel=2e-3)
    assert found["values"]["coefficient std a"] == "0.002" and "coefficient std c" not in found["values"]
    assert found["turned"] == 1
    assert found["title"] == "coefficient std b" and found["limits"][0] < 0.002 < found["limits"][1]
    assert abs(found["place"]["row"] - 48) <= 1 and abs(found["place"]["col"] - 64) <= 1
    # the line of sight through the middle meets hills before or behind it
    assert abs(found["near"]["row"] - 48) <= 30 and abs(found["near"]["col"] - 64) <= 8
    assert "azimuth=101.00" in found["address"] and "layer=coefficient_std_b" in found["address"]
    assert found["shown"] == "none" and found["rate"] > 0


def test_what_is_the_same_everywhere_is_a_line_and_no_layer(tmp_path):
    path, page = make_map(tmp_path, "hapke"), tmp_path / "v.html"
    view.run(path, None, page, view.Config())
    found = run_in_page(
        page,
        """return {line: document.getElementById("constants").textContent,
          layers: [...document.querySelectorAll("#layers button")].map((b) => b.textContent), values: lunargr.values(70, 100)};""",
    )
    varying = [p.name for p in get_model("hapke").parameters if p.name != "c" and p.default]
    assert "c 0.3" in found["line"] and found["layers"][7:] == varying
    assert [name for name, _ in found["values"]][9:] == varying


def test_the_camera_stays_above_ground_however_it_is_moved(tmp_path):
    path, page = make_map(tmp_path, "M2"), tmp_path / "v.html"
    with h5py.File(path) as file:
        elevation, radius = file["elevation"][...], read_grid(file, path).radius
    view.run(path, None, page, view.Config())
    poses = run_in_page(
        page,
        """
        const canvas = document.getElementById("canvas"), poses = [], soon = () => new Promise((done) => setTimeout(done, 100));
        const pointer = (type, clientX, clientY) => canvas.dispatchEvent(new PointerEvent(type,
          {clientX, clientY, pointerId: 1, button: 0, buttons: type === "pointerup" ? 0 : 1, bubbles: true}));
        canvas.setPointerCapture = canvas.releasePointerCapture = () => {};  // of pointers that no hand moves
        for (const camera of ["0,0,-9000,0,0,0", "300,-200,-50,0,0,0", "90000,0,500,80000,0,0"]) {
          location.hash = "view=space&camera=" + camera;
          await soon();
          poses.push(lunargr.pose());
        }
        location.hash = "view=space&camera=100,-2500,1800,0,0,0";
        await soon();
        for (let k = 0; k < 30; k++) {  // come near, then down
          canvas.dispatchEvent(new WheelEvent("wheel", {deltaY: -200, clientX: 300, clientY: 300, bubbles: true}));
          pointer("pointerdown", 300, 300);
          pointer("pointermove", 300, 240);
          pointer("pointerup", 300, 240);
          poses.push(lunargr.pose());
        }
        return poses;
        """,
    )
    assert len({tuple(pose) for pose in poses}) > 20
    for x, y, z, to_x, to_y, _ in poses:
        row, col = (round(float(np.clip(v, 0, n - 1))) for v, n in ((47.5 - y / 20, 96), (63.5 + x / 20, 128)))
        assert np.hypot(np.hypot(x, y), z + radius) - radius > elevation[row, col] + 20  # a pixel at least
        assert abs(to_x) <= 64.1 * 20 and abs(to_y) <= 48.1 * 20


def test_a_coarse_picture_while_the_sun_is_dragged_and_the_whole_one_after(tmp_path):
    rng, page = np.random.default_rng(3), tmp_path / "v.html"
    grid, elevation = make_grid(1024, 1024, 5.0), hills(rng, 1024, 5.0)
    coefficients = np.stack([0.03 + 0.3 * smooth_maps(rng, (1024, 1024), 1)[0], *np.full((2, 1024, 1024), 0.02)])
    view.run(write_svbrdf(tmp_path / "m.h5", grid, elevation, coefficients, "M2"), None, page, view.Config())
    found = run_in_page(
        page,
        """
        const canvas = document.getElementById("canvas"), counts = [{...lunargr.frames}], soon = () => new Promise((done) => setTimeout(done, 100));
        const pointer = (type, clientX) => canvas.dispatchEvent(new PointerEvent(type,
          {clientX, clientY: 300, pointerId: 1, shiftKey: true, buttons: type === "pointerup" ? 0 : 1, bubbles: true}));
        canvas.setPointerCapture = () => {};  // of a pointer that no hand moves
        pointer("pointerdown", 200);
        for (let x = 200; x < 280; x += 10, await soon()) pointer("pointermove", x);
        for (let k = 0; k < 6; k++) await soon();
        counts.push({...lunargr.frames});
        pointer("pointerup", 280);
        for (let k = 0; k < 100 && lunargr.frames.whole === counts[1].whole; k++) await soon();
        counts.push({...lunargr.frames});
        const small = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
        const grey = () => {
          small.drawImage(canvas, 0, 0, 64, 64);
          return Float32Array.from(small.getImageData(0, 0, 64, 64).data.filter((_, k) => k % 4 === 0));
        };
        lunargr.set({auto: false, limits: [0, 0.2], azimuth: 270});
        const pictures = [];
        for (const view of ["map", "space"]) {
          lunargr.set({view});
          lunargr.rate(1, "sun", true);
          pictures.push(grey());
          lunargr.set({});
          pictures.push(grey());
        }
        return {counts, pictures};
        """,
    )
    before, dragged, after = found["counts"]
    assert dragged["coarse"] > before["coarse"] and dragged["whole"] == before["whole"] < after["whole"]
    for coarse, whole in zip(found["pictures"][::2], found["pictures"][1::2], strict=True):
        assert 0 < np.abs(coarse - whole).mean() < 0.05 * whole.std() + 2
        assert np.corrcoef(coarse, whole)[0, 1] > 0.97


def test_a_link_keeps_what_is_seen(small_artefacts, tmp_path):
    from test_view import map_of

    page = tmp_path / "v.html"
    view.run(map_of(small_artefacts["scene"], tmp_path), small_artefacts["pairs"], page, view.Config(photographs=2))
    states = (
        {"view": "space", "layer": 5, "auto": False, "limits": [2.5, 30], "azimuth": 123, "elevation": 7, "shadows": False},
        {"view": "map", "photograph": 1},
    )  # fmt: skip
    found = run_in_page(
        page,
        f"const states = {json.dumps(states)};"
        + """
        const canvas = document.getElementById("canvas"), found = [], soon = (ms) => new Promise((done) => setTimeout(done, ms));
        const seen = () => [{...lunargr.state, limits: lunargr.state.auto || lunargr.state.limits}, lunargr.pose()];
        for (const {photograph, ...state} of states) {
          if (photograph !== undefined) lunargr.photograph(photograph);
          lunargr.set(state);
          for (let k = 0; k < 3; k++) canvas.dispatchEvent(new WheelEvent("wheel", {deltaY: -200, clientX: 200, clientY: 250, bubbles: true}));
          document.getElementById("link").click();
          const link = location.hash, before = seen();
          for (const other of ["view=space&camera=500,-9000,8000,0,0,0", "azimuth=1&elevation=50&view=map&camera=0,0,1"]) {
            location.hash = other;
            await soon(150);
          }
          const between = seen();
          location.hash = link;
          await soon(150);
          found.push([before, between, seen()]);
        }
        return found;
        """,
    )
    for before, between, after in found:
        assert after[0] == before[0] and after[1] == pytest.approx(before[1], rel=1e-4, abs=0.01)
        assert between[0] != before[0] and between[1] != before[1]


def test_a_number_out_of_range_is_put_back(tmp_path):
    page = tmp_path / "v.html"
    view.run(make_map(tmp_path, "M2"), None, page, view.Config())
    shown = run_in_page(
        page,
        """
        const type = (id, text) => {
          const field = document.getElementById(id);
          field.focus();
          field.value = text;
          for (const kind of ["input", "change"]) field.dispatchEvent(new Event(kind, {bubbles: true}));
          return Number(field.value);
        };
        lunargr.set({auto: false, limits: [0.1, 0.3]});
        return [type("elevation", "120"), type("elevation", "-4"), type("elevation", ""), type("azimuth", "400"), type("black", "0.2"),
          type("black", "0.5"), type("white", ""), ...lunargr.state.limits];
        """,
    )
    assert shown == [90, 0.1, 0.1, 40, 0.2, 0.2, 0.3, 0.2, 0.3]


@pytest.mark.parametrize("window", ["900,600", "500,800"])
def test_the_values_are_beside_or_below_the_picture(tmp_path, window):
    page = tmp_path / "v.html"
    view.run(make_map(tmp_path, "M2"), None, page, view.Config())
    picture, values, filled = run_in_page(
        page,
        """const box = (id) => document.getElementById(id).getBoundingClientRect().toJSON(), canvas = document.getElementById("canvas");
        canvas.dispatchEvent(new PointerEvent("pointermove", {clientX: 200, clientY: 150, bubbles: true}));
        await new Promise((done) => setTimeout(done, 300));
        return [box("canvas"), box("values"), document.querySelector("#values dd").textContent];""",
        flags=(f"--window-size={window}",),
    )
    assert values["left"] >= picture["right"] or values["top"] >= picture["bottom"]
    assert filled.endswith("° E") and values["height"] > 50


def test_photographs_match_the_page_under_their_own_sun(small_artefacts, tmp_path):
    from test_view import map_of

    page = tmp_path / "v.html"
    view.run(map_of(small_artefacts["scene"], tmp_path), small_artefacts["pairs"], page, view.Config(photographs=2))
    text = run_in_page(page, "lunargr.photograph(1); return document.getElementById('photograph-text').textContent")
    assert float(re.search(r"correlation (-?[\d.]+)", text).group(1)) > 0.8, text


def test_a_photograph_is_swiped_over_the_rendering(small_artefacts, tmp_path):
    from test_view import map_of

    page, source = tmp_path / "v.html", map_of(small_artefacts["scene"], tmp_path)
    view.run(source, small_artefacts["pairs"], page, view.Config(photographs=1))
    content = read_content(source, 2048)
    given = read_photographs(small_artefacts["pairs"], content.grid, 1, make_frames(content.grid), 1)[0]
    row, col = (n // 2 for n in given.image.shape)
    shown = run_in_page(
        page,
        f"""
        lunargr.photograph(0);
        const canvas = document.getElementById("canvas"), swipe = document.getElementById("swipe"), found = {{}};
        const copy = document.createElement("canvas");
        Object.assign(copy, {{width: canvas.width, height: canvas.height}});
        const context = copy.getContext("2d", {{willReadFrequently: true}}), middle = [canvas.width / 2, canvas.height / 2].map(Math.round);
        const grey = (x, y) => Float32Array.from(context.getImageData(middle[0] + x, middle[1] + y, 60, 60).data.filter((_, k) => k % 4 === 0));
        for (const share of [0, 0.5, 1]) {{
          swipe.value = share;
          swipe.dispatchEvent(new Event("input"));
          lunargr.set({{}});
          context.drawImage(canvas, 0, 0);
          found[share] = [grey(-70, -30), grey(10, -30), grey(-260, -290)];
        }}
        return {{found, values: lunargr.values({given.row + row}, {given.col + col}), residual: document.getElementById("residual").width}};
        """,
    )
    (left_0, right_0, out_0), (left, right, out), (left_1, right_1, out_1) = (
        shown["found"][k] for k in ("0", "0.5", "1")
    )
    assert np.array_equal(left, left_1) and np.array_equal(right, right_0)
    assert np.array_equal(out, out_0) and np.array_equal(out, out_1)
    assert not np.array_equal(left, left_0) and not np.array_equal(right, right_1)
    known = given.image[np.isfinite(given.image)]
    half_step = np.subtract(*np.percentile(known, (99, 1))) / 512
    assert dict(shown["values"])["Measured"] and shown["residual"] == given.image.shape[1]
    assert float(dict(shown["values"])["Measured"]) == pytest.approx(given.image[row, col], abs=1.1 * half_step + 1e-4)


def test_going_measuring_grid_and_scale_are_those_of_the_map(tmp_path):
    rng, page = np.random.default_rng(5), tmp_path / "v.html"
    grid, elevation = make_grid(96, 128, 20.0), 0.1 * hills(rng, 128, 20.0)[:96] + 900.0
    coefficients = np.full((3, 96, 128), 0.1)
    view.run(write_svbrdf(tmp_path / "m.h5", grid, elevation, coefficients, "M2"), None, page, view.Config())
    to_lon, to_lat = (float(v) for v in grid.lonlat(30, 90))
    found = run_in_page(
        page,
        f"const wanted = '{to_lon}, {to_lat}';"
        + """
        const byId = (id) => document.getElementById(id), canvas = byId("canvas"), found = {};
        const middle = [canvas.clientWidth / 2, canvas.clientHeight / 2], centre = () => lunargr.pick(...middle);
        const go = (text) => {
          byId("go").value = text;
          byId("go").dispatchEvent(new Event("change"));
          return [byId("go").validity.valid, centre()];
        };
        const click = (x, y) => ["pointerdown", "pointerup"].map((kind) => canvas.dispatchEvent(
          new PointerEvent(kind, {clientX: x, clientY: y, pointerId: 1, buttons: kind === "pointerup" ? 0 : 1, bubbles: true})));
        canvas.setPointerCapture = canvas.releasePointerCapture = () => {};  // of pointers that no hand moves
        byId("grid").click();
        byId("measure").click();
        found.ends = [[middle[0] - 150, middle[1] - 80], [middle[0] + 160, middle[1] + 90]].map((at) => (click(...at), lunargr.pick(...at)));
        found.measured = byId("profile-text").textContent;
        found.lines = [...document.querySelectorAll("#overlay polyline.grid:has(+ text)")].map((line) => {
          const at = line.points[Math.floor(line.points.length / 2)], {row, col} = lunargr.pick(at.x, at.y) ?? {};
          return [line.nextSibling.textContent, row, col];
        });
        found.far = go("0, 0");
        found.wrong = go("north");
        found.there = go(wanted);
        lunargr.set({view: "space"});
        found.space = go(wanted);
        const wide = byId("scale-bar").querySelector("i").getBoundingClientRect().width;
        found.bar = [byId("scale-bar").textContent.trim(), lunargr.pick(middle[0] - wide / 2, middle[1]), lunargr.pick(middle[0] + wide / 2, middle[1])];
        return found;
        """,
    )

    def apart(a, b):
        points = [unit_vectors(*(float(v) for v in grid.lonlat(p["row"], p["col"]))) for p in (a, b)]
        return grid.radius * float(np.linalg.norm(points[0] - points[1]))

    a, b = found["ends"]
    number, unit, rise = re.match(r"([\d.]+) (k?m), (?:up|down) ([\d.]+) m", found["measured"]).groups()
    assert float(number) * {"m": 1, "km": 1000}[unit] == pytest.approx(apart(a, b), rel=1e-3)
    assert float(rise) == pytest.approx(abs(elevation[b["row"], b["col"]] - elevation[a["row"], a["col"]]), abs=0.1)
    assert len(found["lines"]) >= 6
    for name, row, col in found["lines"]:
        lon, lat = (float(v) for v in grid.lonlat(row, col))
        pixel = 20.0 / grid.radius * 180 / np.pi
        value = float(name.split("°")[0])
        assert abs((lon % 360 - value) * np.cos(np.radians(lat)) if name.endswith("E") else lat - value) < 1.5 * pixel
    assert not found["far"][0] and not found["wrong"][0]
    for right, at in (found["there"], found["space"]):
        assert right and abs(at["row"] - 30) <= 1 and abs(at["col"] - 90) <= 1
    assert found["far"][1] == found["wrong"][1] != found["there"][1]
    text, *sides = found["bar"]
    number, unit = re.match(r"([\d.]+) (k?m) in the middle", text).groups()
    # a bar of a hundred pixels, each side of it to the nearest pixel of 20 m
    assert float(number) * {"m": 1, "km": 1000}[unit] == pytest.approx(apart(*sides), abs=25, rel=0.03)


def test_the_page_works_under_its_own_policy_of_no_network_at_all(tmp_path):
    page = tmp_path / "v.html"
    view.run(make_map(tmp_path, "M2"), None, page, view.Config())
    assert 'data-lunargr="ready"' in read_dom(page)


def test_without_webgl_there_is_a_sentence_and_a_picture(tmp_path):
    page = tmp_path / "v.html"
    view.run(make_map(tmp_path, "M2"), None, page, view.Config())
    found = run_in_page(
        page,
        """const picture = document.querySelector("#fallback img");
        await picture.decode();
        return {able: lunargr.able, text: document.getElementById("why").innerText, width: picture.naturalWidth,
          seen: picture.getBoundingClientRect().width};""",
        flags=("--disable-3d-apis",),
    )
    assert found["able"] is False and "WebGL 2" in found["text"]
    assert found["width"] == 128 and found["seen"] > 100


# One pixel per set of angles and parameters: the bare formula of every model, without the page around it.
PROBE = """<!DOCTYPE html><html><body><canvas id="c" width="1" height="1"></canvas><script>
window.lunargr = {};
function probe(model, count, parameters, angles) {
  const gl = document.getElementById("c").getContext("webgl2"), n = angles.length / 3;
  gl.getExtension("EXT_color_buffer_float");
  const shader = (type, text) => { const s = gl.createShader(type); gl.shaderSource(s, text); gl.compileShader(s);
    if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(s)); return s; };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, `#version 300 es
    void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, `#version 300 es
    precision highp float; precision highp sampler2D;
    #define PI 3.141592653589793
    #define COUNT ${count}
    uniform sampler2D cosines, given; out vec4 result;
    float phase_angle(float cosine) { return acos(clamp(cosine, -1.0 + 1e-7, 1.0 - 1e-7)); }
    ${model}
    void main() { int x = int(gl_FragCoord.x); vec3 c = texelFetch(cosines, ivec2(x, 0), 0).rgb; float p[COUNT];
      for (int k = 0; k < COUNT; k++) p[k] = texelFetch(given, ivec2(x, k), 0).r;
      result = vec4(radiance_factor(p, c.x, c.y, c.z)); }`));
  gl.linkProgram(program); gl.useProgram(program);
  const texture = (unit, data, width, height, inner, format) => { gl.activeTexture(gl.TEXTURE0 + unit);
    const t = gl.createTexture(); gl.bindTexture(gl.TEXTURE_2D, t);
    gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, format, gl.FLOAT, data);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST); return t; };
  texture(0, new Float32Array(angles), n, 1, gl.RGB32F, gl.RGB);
  texture(1, new Float32Array(parameters), n, count, gl.R32F, gl.RED);
  gl.uniform1i(gl.getUniformLocation(program, "cosines"), 0); gl.uniform1i(gl.getUniformLocation(program, "given"), 1);
  const into = texture(2, null, n, 1, gl.RGBA32F, gl.RGBA);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, into, 0);
  gl.viewport(0, 0, n, 1); gl.drawArrays(gl.TRIANGLES, 0, 3);
  const out = new Float32Array(4 * n); gl.readPixels(0, 0, n, 1, gl.RGBA, gl.FLOAT, out);
  return out.filter((v, k) => k % 4 === 0);
}
</script></body></html>"""


def test_every_models_formula_in_glsl_is_its_formula_here(tmp_path):
    rng = np.random.default_rng(11)
    n = 600
    incidence, emission = rng.uniform(0, np.radians(85), (2, n))
    azimuth = rng.uniform(0, np.pi, n)
    cosine = np.cos(incidence) * np.cos(emission) + np.sin(incidence) * np.sin(emission) * np.cos(azimuth)
    # nearer to opposition than half a degree the cosine in single precision no longer holds the angle
    phase = np.clip(np.arccos(np.clip(cosine, -1, 1)), np.radians(0.5), np.radians(170))
    cosines = np.stack([np.cos(incidence), np.cos(emission), np.cos(phase)], axis=1)
    script, expected = "return [", []
    for name in model_names():
        model = get_model(name)
        assert model.glsl is not None
        given = np.stack(
            [
                p.default + rng.uniform(0, 0.4, n) * (p.upper - p.default) * (rng.random(n) < 0.5)
                for p in model.parameters
            ]
        )
        named = dict(zip((p.name for p in model.parameters), given, strict=True))
        expected.append(evaluate(name, named, incidence, emission, phase))
        numbers = json.dumps([float(f"{v:.9g}") for v in given.ravel()])
        script += f"probe({json.dumps(model.glsl)}, {len(given)}, {numbers}, angles),"
    (tmp_path / "probe.html").write_text(PROBE)
    angles = json.dumps([float(f"{v:.9g}") for v in cosines.ravel()])
    found = run_in_page(tmp_path / "probe.html", f"const angles = {angles}; {script}]")
    for name, got, wanted in zip(model_names(), found, expected, strict=True):
        # of M6 two cosines turn over within a few rounding errors of the direction halfway between Sun and camera
        floor = (5e-3 if name == "M6" else 2e-4) * np.abs(wanted).max()
        np.testing.assert_allclose(got, wanted, rtol=2e-3, atol=floor, err_msg=name)
