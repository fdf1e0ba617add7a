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
from stages.physics.photometry import evaluate, get_model, model_names
from stages.render.pictures import read_exr

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


def test_photographs_match_the_page_under_their_own_sun(small_artefacts, tmp_path):
    from test_view import map_of

    page = tmp_path / "v.html"
    view.run(map_of(small_artefacts["scene"], tmp_path), small_artefacts["pairs"], page, view.Config(photographs=2))
    text = run_in_page(page, "lunargr.photograph(1); return document.getElementById('photograph-text').textContent")
    assert float(re.search(r"correlation (-?[\d.]+)", text).group(1)) > 0.8, text


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
