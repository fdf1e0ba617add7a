"""Images with I/F below 0: project counts them by image, and merged parts count alike."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
import small_scene

from stages import ingest, project, sample
from stages.project.summary import summarise


@pytest.mark.parametrize("units", ["iof", "dn"])
def test_images_with_negative_brightness_are_counted(tmp_path, units, rng):
    files = small_scene.write_scene(tmp_path, images=2)
    with rasterio.open(tmp_path / "image1.tif", "r+") as raster:
        values = raster.read(1)
        values[(values != raster.nodata) & (rng.random(values.shape) < 0.5)] -= 1.0
        raster.write(values, 1)
    files.images.write_text(files.images.read_text().replace(",iof,", f",{units},"))
    scene, crops, pairs = (tmp_path / name for name in ("scene.h5", "crops.h5", "pairs.h5"))
    ingest.run(files.dem, files.images, scene, ingest.Config(crop=32))
    sample.run(scene, crops, sample.Config(crop=32, count=40))
    summary = project.run(crops, pairs, project.Config())
    merged = summarise(pairs)
    assert summary.negative == pytest.approx(dict(merged.negative), abs=1e-3)
    assert set(summary.negative) == ({"IMG1"} if units == "iof" else set())
    for share in summary.negative.values():  # means over about 3 image pixels, of which half are low by 1
        assert 0.5 < share <= 1.0
    assert np.isfinite(summary.valid_share)
