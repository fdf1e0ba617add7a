"""Registration on the embedded scene: photographs of an albedo that follows craters, over Suns high and low."""

from __future__ import annotations

import csv

import h5py
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from typer.testing import CliRunner

from lunargr_cli.main import app

PLANTED = [(4.0, -4.0), (-3.25, 2.5), (1.75, 3.6), (-4.0, -0.5)]


def run(*words):
    done = CliRunner().invoke(app, [str(w) for w in words])
    assert done.exit_code == 0, done.output


@pytest.mark.slow
def test_planted_shifts_on_the_embedded_scene(tmp_path):
    """Each image's georeference is moved by up to 4 px per axis; project --register finds it to 0.1 px on both."""
    scene = tmp_path / "scene"
    run("simulate", "--size-px", 1024, "--images", 6, "--seed", 7, "--hidden", "none", "-o", scene)
    with (scene / "images.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    truth = {}
    for k, row in enumerate(rows):
        east, south = truth[row["image_id"]] = PLANTED[k % len(PLANTED)]
        with rasterio.open(scene / row["path"], "r+") as image:
            image.transform = Affine.translation(5 * east, -5 * south) @ image.transform
    run("ingest", scene / "dem.tif", "--images", scene / "images.csv", "--gsd", 5, "-o", tmp_path / "scene.h5")
    run("sample", tmp_path / "scene.h5", "--count", 300, "-o", tmp_path / "crops.h5")
    run("project", tmp_path / "crops.h5", "--register", "-o", tmp_path / "pairs.h5")
    with h5py.File(tmp_path / "pairs.h5") as pairs:
        names = [n.decode() if isinstance(n, bytes) else n for n in pairs["image_id"][...]]
        found = np.stack([pairs["shift_col_px"][...], pairs["shift_row_px"][...]], axis=1)
        sigma = pairs["shift_sigma_px"][...]
    error = np.abs(found - np.array([truth[name] for name in names])).max(axis=1)
    assert np.isfinite(error).all(), "an image was refused"
    assert error.max() < 0.1
    assert np.all(error < 3 * sigma) and sigma.max() < 0.2
