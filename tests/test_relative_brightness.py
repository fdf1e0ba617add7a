"""Maps that were learned from images in DN: their brightness is named relative I/F wherever it is shown."""

from __future__ import annotations

import json

import h5py
import pytest
import rasterio
from typer.testing import CliRunner

from lunargr_cli.main import app
from stages import view


@pytest.mark.parametrize(("units", "name"), [("iof", "I/F"), ("dn", "relative I/F")])
def test_renderings_and_pages_name_the_brightness(hilly_map, tmp_path, units, name, monkeypatch):
    path = hilly_map[0]
    with h5py.File(path, "r+") as file:
        file.attrs["image_units"] = units
    monkeypatch.setenv("COLUMNS", "200")
    words = ["render", str(path), "--sun-azimuth", "90", "--sun-elevation", "40", "--json", str(tmp_path / "r.json")]
    result = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "r.tif")])
    assert result.exit_code == 0 and f"mean {name}" in result.output
    assert json.loads((tmp_path / "r.json").read_text())["views"][0]["image_units"] == units
    with rasterio.open(tmp_path / "r.tif") as tiff:
        assert tiff.tags()["quantity"].startswith("relative I/F" if units == "dn" else "radiance factor I/F")
    view.run(path, None, tmp_path / "page.html", view.Config(max_px=64))
    assert f'"brightness":"{name}"' in (tmp_path / "page.html").read_text().replace('": "', '":"')
