"""Converters between the conventions of other programs, as functions and as `lunargr convert`; `lunargr models`."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from typer.testing import CliRunner

from lunargr_cli.main import app
from schemas import ConfigError, InputError, RegistryError
from schemas.files.outputs import Output
from stages import convert
from stages.physics.photometry import evaluate, get_model, model_names
from stages.physics.photometry.conventions import conventions, convert_maps, get_convention

FOREIGN = [c for c in conventions() if not c.name.startswith("lunargr:")]
GEOMETRY = (math.radians(50), math.radians(20), math.radians(40))


def sample(convention, rng, shape=(3, 4)):
    """Maps in the physical range of each quantity."""
    special = {"Theta": (0, 40), "theta": (0, 40), "phi": (0, 0.5), "f_alpha": (0.3, 0.9), "K": (0.2, 1.5)}
    small = {"A": 0.02, "B": 3e-4, "C": 2e-6}
    maps = {}
    for name, _ in convention.quantities:
        low, high = special.get(name, (0.1, 0.9))
        if convention.name == "asp:LunarLambert" and name in small:
            low, high = -small[name], small[name]
        maps[name] = rng.uniform(low, high, shape)
    return maps


@pytest.mark.parametrize("convention", FOREIGN, ids=lambda c: c.name)
def test_there_and_back(convention, rng):
    maps = sample(convention, rng)
    ours, lost = convert_maps(maps, convention.name, f"lunargr:{convention.model}")
    assert not lost
    assert list(ours) == [p.name for p in get_model(convention.model).parameters]
    again, lost = convert_maps(ours, f"lunargr:{convention.model}", convention.name)
    assert not lost
    assert list(again) == convention.names
    for name in maps:
        assert again[name] == pytest.approx(maps[name], rel=1e-12, abs=1e-15), name


@pytest.mark.parametrize("convention", conventions(), ids=lambda c: c.name)
def test_every_convention_names_its_units(convention):
    assert len(set(convention.names)) == len(convention.names)
    assert all(unit for _, unit in convention.quantities)
    assert convention.returns.startswith(("I/F", "r = I/F / pi"))
    assert set(convention.implied) <= {p.name for p in get_model(convention.model).parameters}


def test_asp_c_is_half_of_one_plus_satos():
    values = {"w": 0.4, "b": 0.23, "c": 0.46824, "Bc0": 0, "hc": 1, "Bs0": 1.7, "hs": 0.05, "theta": 0, "phi": 0}
    asp, lost = convert_maps(values, "sato:Hapke", "asp:Hapke", approximate=True)
    assert float(asp["c"]) == (1 + 0.46824) / 2
    assert list(lost.values()) == ["the H function (2002 or 1981) changes from hapke to hapke_h1981"]


def test_isis_negative_asymmetry_is_the_other_lobe():
    """A single lobe with Hg1 = -0.3, Hg2 = 0 scatters backward: the same as +0.3 with all weight behind."""
    common = {"Wh": 0.3, "Hh": 0.05, "B0": 1.0, "Theta": 20.0}
    one, _ = convert_maps({**common, "Hg1": -0.3, "Hg2": 0.0}, "isis:HapkeHen", "lunargr:hapke_h1981")
    two, _ = convert_maps({**common, "Hg1": 0.3, "Hg2": 1.0}, "isis:HapkeHen", "lunargr:hapke_h1981")
    assert {k: float(v) for k, v in one.items()} == {k: float(v) for k, v in two.items()}
    i, e, g = GEOMETRY
    phase_function = (1 - 0.09) / (1 + 0.09 - 0.6 * math.cos(g)) ** 1.5  # ISIS' own formula at Hg1 = -0.3
    flat = {**one, "Bs0": 0.0, "theta": 0.0}
    difference = evaluate("hapke_h1981", flat, i, e, g) - evaluate("hapke_h1981", {**flat, "b": 0.0}, i, e, g)
    mu0, mu = math.cos(i), math.cos(e)
    assert difference == pytest.approx(0.3 / 4 * mu0 / (mu0 + mu) * (phase_function - 1), rel=1e-9)


def test_reference_implementation_stores_cos_phase_first():
    """Its M2 texture is (cos g, cos i, 1) of r, through LeakyReLU(0.01)."""
    ours, _ = convert_maps({"x": 0.01, "y": 0.05, "z": -0.02}, "g2r:polynomial_3p_cst", "lunargr:M2")
    assert {k: float(v) for k, v in ours.items()} == pytest.approx(
        {"a": 0.05 * math.pi, "b": 0.01 * math.pi, "c": -0.0002 * math.pi}
    )


def test_what_the_target_cannot_hold_is_refused_by_name():
    values = {"w": 0.4, "b": 0.23, "c": 0.4, "Bs0": 1.7, "hs": 0.05, "Bc0": 0.5, "hc": 1.0, "theta": 0.4, "phi": 0.0}
    with pytest.raises(ConfigError, match=r"Bc0 = 0\.5 becomes 0; theta = 0\.4 becomes 0; give `approximate`"):
        convert_maps(values, "lunargr:hapke_h1981", "asp:Hapke")
    asp, lost = convert_maps(values, "lunargr:hapke_h1981", "asp:Hapke", approximate=True)
    assert len(lost) == 2
    assert float(asp["omega"]) == 0.4


def test_different_models_are_refused_with_the_choices():
    with pytest.raises(ConfigError, match=r"different models \(M2 and hapke_h1981\).*converts to: lunargr:M2"):
        convert_maps({"x": 1, "y": 1, "z": 1}, "g2r:polynomial_3p_cst", "asp:Hapke")
    with pytest.raises(RegistryError, match=r"unknown convention 'asp:Hapkee'; choose one of: .*asp:Hapke"):
        get_convention("asp:Hapkee")


# the GeoTIFF stage


def write_maps(path, maps, nodata=None, descriptions=True):
    first = next(iter(maps.values()))
    profile = {
        "driver": "GTiff",
        "height": first.shape[0],
        "width": first.shape[1],
        "count": len(maps),
        "dtype": "float64",
        "crs": "+proj=eqc +R=1737400",
        "transform": Affine(5, 0, 1000, 0, -5, 2000),
        "nodata": nodata,
    }
    with rasterio.open(path, "w", **profile) as target:
        for k, (name, values) in enumerate(maps.items(), start=1):
            target.write(values, k)
            if descriptions:
                target.set_band_description(k, name)
    return path


@pytest.fixture
def sato(tmp_path, rng):
    """A Sato map whose bands stand in another order than the convention's, with a nodata pixel."""
    maps = sample(get_convention("sato:Hapke"), rng, (27, 5))
    maps = {name: maps[name] for name in reversed(maps)}
    for values in maps.values():
        values[2, 3] = -9999.0
    return write_maps(tmp_path / "sato.tif", maps, nodata=-9999.0), maps


def test_convert_writes_the_same_reflectance(sato, tmp_path, monkeypatch):
    source, maps = sato
    monkeypatch.setattr("stages.convert.stage.BLOCK_VALUES", 5 * 9 * 8)  # eight rows at a time
    steps = []
    report = convert.run(
        source,
        tmp_path / "ours.tif",
        convert.Config("sato:Hapke", "lunargr:hapke"),
        progress=lambda done, total, what: steps.append((done, total)),
    )
    assert report.valid_pixels == 134
    assert steps[-1] == (27, 27)
    assert len(steps) == 4
    with rasterio.open(source) as before, rasterio.open(tmp_path / "ours.tif") as after:
        assert (after.crs, after.transform, after.shape) == (before.crs, before.transform, before.shape)
        assert after.descriptions == tuple(p.name for p in get_model("hapke").parameters)
        assert dict(zip(after.descriptions, after.units, strict=True))["theta"] == "rad"
        assert after.tags()["CONVENTION"] == "lunargr:hapke"
        ours = dict(zip(after.descriptions, after.read(), strict=True))
    assert np.isnan(ours["w"][2, 3])
    assert np.isfinite(ours["w"]).sum() == 134
    written = evaluate("hapke", {k: v[0, 0] for k, v in ours.items()}, *GEOMETRY)
    direct = evaluate(
        "hapke",
        {**{k: v[0, 0] for k, v in maps.items() if k != "theta"}, "theta_deg": maps["theta"][0, 0]},
        *GEOMETRY,
    )
    assert written == pytest.approx(direct, rel=1e-6)


def test_convert_never_touches_its_input_or_an_existing_file(sato, tmp_path):
    source, _ = sato
    config = convert.Config("sato:Hapke", "lunargr:hapke")
    with pytest.raises(ConfigError, match="would replace the input"):
        convert.run(source, Output(source, overwrite=True), config)
    other = tmp_path / "other.tif"
    other.write_text("mine")
    with pytest.raises(ConfigError, match="exists already"):
        convert.run(source, other, config)
    assert other.read_text() == "mine"
    convert.run(source, Output(other, overwrite=True), config)
    with pytest.raises(ConfigError, match="cannot hold all"):
        convert.run(source, tmp_path / "asp.tif", convert.Config("sato:Hapke", "asp:Hapke"))
    assert not list(tmp_path.glob("*asp*"))


def test_bands_are_found_by_name_only(tmp_path, rng):
    maps = sample(get_convention("asp:Hapke"), rng)
    unnamed = write_maps(tmp_path / "unnamed.tif", maps, descriptions=False)
    config = convert.Config("asp:Hapke", "lunargr:hapke_h1981")
    with pytest.raises(InputError, match=r"expected band descriptions omega,b,c,B0,h .* `bands` omega,b,c,B0,h"):
        convert.run(unnamed, tmp_path / "out.tif", config)
    named = convert.Config("asp:Hapke", "lunargr:hapke_h1981", bands=["omega", "b", "c", "B0", "h"])
    convert.run(unnamed, tmp_path / "out.tif", named)
    with rasterio.open(tmp_path / "out.tif") as data:
        assert data.read(1) == pytest.approx(maps["omega"], rel=1e-6)
    swapped = ["h=5", "B0=4", "c=3", "b=1", "omega=2"]
    convert.run(unnamed, tmp_path / "swap.tif", convert.Config("asp:Hapke", "lunargr:hapke_h1981", bands=swapped))
    with rasterio.open(tmp_path / "swap.tif") as data:
        assert data.read(1) == pytest.approx(maps["b"], rel=1e-6)
    with pytest.raises(ConfigError, match="`bands`: expected NAME=INDEX with an index from 1 to 5, found 'omega=6'"):
        convert.run(unnamed, tmp_path / "x.tif", convert.Config("asp:Hapke", "lunargr:hapke_h1981", bands=["omega=6"]))
    with pytest.raises(ConfigError, match="`bands`: expected 5 names"):
        convert.run(unnamed, tmp_path / "x.tif", convert.Config("asp:Hapke", "lunargr:hapke_h1981", bands=["omega"]))
    partial = write_maps(tmp_path / "partial.tif", {k: maps[k] for k in ("omega", "b", "c", "B0")})
    with pytest.raises(InputError, match="expected one band 'h' for asp:Hapke, found 0 among 'omega, b, c, B0'"):
        convert.run(partial, tmp_path / "x.tif", config)
    with pytest.raises(InputError, match="no such file"):
        convert.run(tmp_path / "missing.tif", tmp_path / "x.tif", config)


# the commands


def test_convert_command(sato, tmp_path):
    source, maps = sato
    arguments = ["convert", str(source), "--from", "sato:Hapke", "--to", "asp:hapke", "-o", str(tmp_path / "asp.tif")]
    result = CliRunner().invoke(app, [*arguments, "--approximate"])
    assert result.exit_code == 0, result.output
    assert "asp:Hapke, 134 valid pixels; its formula gives r = I/F / pi" in result.output
    assert "lost: the H function" in result.output
    with rasterio.open(tmp_path / "asp.tif") as data:
        assert data.descriptions == ("omega", "b", "c", "B0", "h")
        assert data.read(3)[0, 0] == pytest.approx((1 + maps["c"][0, 0]) / 2, rel=1e-6)


def test_convert_command_says_in_one_line_what_is_wrong(sato, tmp_path):
    source, _ = sato
    code = "import sys; from lunargr_cli.main import main; sys.argv = ['lunargr', *sys.argv[1:]]; main()"
    arguments = ["convert", str(source), "--from", "sato:Hapke", "--to", "lunargr:M2", "-o", str(tmp_path / "m2.tif")]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert done.returncode == 3
    assert done.stderr.count("\n") == 1
    assert "different models (hapke and M2)" in done.stderr


def test_models_command_lists_everything(tmp_path):
    def text(*arguments):
        result = CliRunner().invoke(app, ["models", *arguments])
        assert result.exit_code == 0, result.output
        return result.output

    everything = text()
    assert all(name in everything for name in model_names())
    assert "reciprocal" in everything
    one = text("hapke")
    for parameter in get_model("hapke").parameters:
        assert parameter.name in one
    assert "[p (1 + Bs0 Bs) + H(mu0e/K) H(mue/K) - 1]" in one  # brackets are text, not markup
    assert "sato2014_643nm" in one
    assert "sato:Hapke" in one
    assert "helfenstein1987" in text("--sets")
    assert "asp:LunarLambert" in text("--conventions")
    text("--json", str(tmp_path / "models.json"))
    data = json.loads((tmp_path / "models.json").read_text())
    assert set(data["models"]) == set(model_names())
    assert data["models"]["M2"]["reciprocal"] is False
    assert data["models"]["hapke"]["parameters"][0] == {
        "name": "w", "unit": "1", "lower": 0.0, "upper": 1.0, "default": 0.38138, "description": "single-scattering albedo",
    }  # fmt: skip
