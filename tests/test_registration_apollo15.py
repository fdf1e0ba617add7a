"""Real photographs that were never orthorectified: relief displacement is found, and held-out ground is explained better."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch

from stages import ingest, project, sample
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form
from stages.physics.photometry import get_model


def unexplained(path, valid):
    """Variance of the images' residual about gain and offset of a uniform Lunar-Lambert surface."""
    model = get_model("lunar_lambert")
    coefficients = torch.tensor([p.default for p in model.parameters])[None, :, None, None]
    with PairReader(path) as reader:
        batch = reader.batch(np.arange(len(valid)))
        rendered = form(batch.observation, model, coefficients.expand(len(valid), -1, 1, 1))[valid].double()
        image = batch.image[valid].double()
    design = torch.stack([rendered, torch.ones_like(rendered)], dim=1)
    return float((image - design @ torch.linalg.lstsq(design, image[:, None]).solution[:, 0]).var())


@pytest.mark.slow
def test_an_apollo_frame_is_put_right(shared, tmp_path):
    data = shared / "data" / "apollo15"
    with (data / "images.csv").open(newline="") as stream:
        row = next(r for r in csv.DictReader(stream) if r["image_id"] == "AS15-M-0297")
    table = tmp_path / "images.csv"
    with table.open("w", newline="") as stream:
        out = csv.DictWriter(stream, row)
        out.writeheader()
        out.writerow(row | {"path": str(data / row["path"])})
    ingest.run(data / "gld100_64ppd.tif", table, tmp_path / "scene.h5", ingest.Config(gsd=474.0, crop=48))
    sample.run(tmp_path / "scene.h5", tmp_path / "crops.h5", sample.Config(count=150, tile_m=32000, crop=48))
    project.run(tmp_path / "crops.h5", tmp_path / "plain.h5", project.Config())
    summary = project.run(tmp_path / "crops.h5", tmp_path / "field.h5", project.Config(register="field"))
    field = summary.registered[0].field
    assert field.accepted and field.form == "field + relief" and field.held_out > 0.5
    assert abs(field.share - 1) < 0.15 and field.share_error < 0.1
    with PairReader(tmp_path / "plain.h5") as plain, PairReader(tmp_path / "field.h5") as moved:
        which = np.arange(len(plain.split))
        valid = (plain.batch(which).valid & moved.batch(which).valid).bool()
    assert unexplained(tmp_path / "field.h5", valid) < 0.7 * unexplained(tmp_path / "plain.h5", valid)
