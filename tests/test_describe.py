"""What `lunargr inspect` says of files of other programs: places, sizes, times and Suns against what is known of them."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import small_scene
from command import outcome as lunargr
from rasterio.crs import CRS
from rasterio.transform import Affine

from stages.physics.images.describe import describe

DEGREE = np.radians(1) * small_scene.RADIUS


def numbers(text):
    return [float(v) for v in re.findall(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", text)]


def test_a_map_beyond_180_degrees(tmp_path):
    """An equirectangular map about 0 E of 179 to 183 E and 2 S to 1 N, 0.02 deg a pixel, taken at a known time."""
    crs = CRS.from_proj4(f"+proj=eqc +lon_0=0 +R={small_scene.RADIUS} +units=m +no_defs")
    step = 0.02 * DEGREE
    values = np.full((150, 200), 0.04, np.float32)
    values[:15] = -0.01
    path = small_scene.write_raster(
        tmp_path / "M143947267L.tif", values, crs, Affine(step, 0, 179 * DEGREE, 0, -step, DEGREE)
    )
    title, facts = describe(path)
    assert "map" in title and facts["size"].startswith("150 lines x 200 samples")
    assert numbers(facts["longitude"]) == pytest.approx([179, 183], abs=1e-3)
    assert numbers(facts["latitude"]) == pytest.approx([-2, 1], abs=1e-3)
    assert numbers(facts["ground sampling"])[:2] == pytest.approx([step, step], rel=1e-3)
    assert facts["values"].endswith("10.0% below 0")
    assert facts["time"].startswith("2010-11-09T13:06:4")  # of the product id
    # the Sun stands over 143.6 E 1.1 S then: 37.4 deg from the middle, by spherical trigonometry
    assert numbers(facts["Sun"])[:2] == pytest.approx([143.6, -1.1], abs=0.1)
    assert numbers(facts["Sun"])[2] == pytest.approx(37.4, abs=0.1)
    assert numbers(facts["DEM"])[:2] == pytest.approx([step, 150 * step / 128], rel=3e-3)


def test_a_cube_with_its_camera(shared, tmp_path):
    """Against ISIS's campt of the same cube's middle: place, resolution, incidence, emission, altitude."""
    code, said = lunargr(
        "inspect", shared / "data/formats/M143947267L.cal.echo.crop.cub", "--json", tmp_path / "i.json"
    )
    assert code == 0, said
    facts = json.loads((tmp_path / "i.json").read_text())["facts"]
    assert facts["camera"] == "line-scan" and facts["time"].startswith("2010-11-09T13:06:46")
    west, east = numbers(facts["longitude"])
    south, north = numbers(facts["latitude"])
    assert west < 102.6015 < east and south < 35.98 < north
    assert numbers(facts["size on the ground"])[:2] == pytest.approx(
        [400 * v for v in numbers(facts["ground sampling"])[:2]], rel=1e-3
    )


def test_files_that_show_no_ground_say_what_they_lack(tmp_path):
    camera = tmp_path / "camera.json"
    camera.write_text("{}")
    code, said = lunargr("inspect", camera)
    assert code == 3 and len(said.splitlines()) == 1
    (tmp_path / "text.txt").write_text("no raster")
    code, said = lunargr("inspect", tmp_path / "text.txt")
    assert code == 3 and len(said.splitlines()) == 1
