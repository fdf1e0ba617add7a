"""The examples on photometry run, and the page that they write is up to date."""

from __future__ import annotations

import importlib.util
import json
import sys

import numpy as np
import photometry_oracles as oracles
import pytest
from conftest import ROOT, SHARED

from stages.physics.photometry import base, catalogue, evaluate, get_model, model_names


def load(name, monkeypatch):
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)  # where dataclasses look for their module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def new_model(monkeypatch):
    """The example's model, known for the length of one test."""
    monkeypatch.setattr(base, "_MODELS", dict(base._MODELS))
    return load("new_reflectance_model", monkeypatch)


def test_a_new_model_is_one_file(new_model, capsys):
    assert "ashikhmin_shirley" in model_names()
    assert "ashikhmin_shirley" in catalogue.markdown()
    assert get_model("Ashikhmin_Shirley").parameters[0].name == "albedo"
    new_model.main()
    assert "d(I/F) / d(albedo)" in capsys.readouterr().out


def test_the_new_model_agrees_with_giant(new_model, shared):
    """GIANT leaves out the factor 28/23."""
    rows = oracles.read(SHARED / "oracles" / "giant_illumination_dense_grid.csv")
    rows = [r for r in rows if r["model"] == "AshikhminShirleyDiffuseIllumination"]
    albedo = json.loads(rows[0]["params_json"])["albedo"] * 23 / 28
    computed = evaluate("ashikhmin_shirley", {"albedo": albedo}, *oracles.angles(rows))
    assert len(rows) == 240
    assert computed == pytest.approx(oracles.columns(rows, "expected")[0], rel=1e-12)


def test_contact_sheet(tmp_path, monkeypatch):
    sheet = load("contact_sheet", monkeypatch)
    elevation = sheet.make_terrain(48, 5.0)
    lights = [sheet.LIGHTS[0], sheet.LIGHTS[2]]
    models = ["lambert", "hapke"]
    images = sheet.render(elevation, 5.0, models, lights)
    assert all(np.isfinite(image).all() and image.shape == (48, 48) for image in images.values())
    assert images["lambert", 0].mean() > 2 * images["lambert", 1].mean()
    # the full Moon is flat and Lambert is not; a low Sun shades both
    flatness = {name: images[name, 0].std() / images[name, 0].mean() for name in models}
    assert flatness["hapke"] < flatness["lambert"]
    sheet.draw(images, models, lights, tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").read_bytes()[:4] == b"\x89PNG"


def test_the_page_holds_every_model_set_and_convention():
    """If this fails after a change to a model: python examples/photometry_page.py"""
    text = (ROOT / "docs" / "photometry.md").read_text()
    assert catalogue.markdown() in text
    for name in model_names():
        assert f"### `{name}`" in text or f"`{name}`, " in text or f", `{name}`" in text
