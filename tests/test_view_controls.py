"""What a person does on the page of `lunargr view`, in a real headless Chromium: camera, link, numbers, photographs, tools."""

from __future__ import annotations

import json
import re

import h5py
import numpy as np
import pytest
from browser import chromium, run_in_page
from relief import hills
from render_scene import make_grid, smooth_maps, write_svbrdf
from test_view import map_of
from test_view_browser import make_map

from stages import view
from stages.physics.maps.grid import read_grid, unit_vectors
from stages.view.frames import make_frames
from stages.view.layers import read_content
from stages.view.photographs import read_photographs


@pytest.fixture(scope="module", autouse=True)
def browser():
    return chromium()


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


def test_a_photograph_is_swiped_over_the_rendering(small_artefacts, tmp_path):
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
