"""What a diagnosis learns hangs on its training pairs; the test pairs score it, and may take a name back, no more."""

from __future__ import annotations

import json
import shutil

import h5py
import numpy as np
import pytest
from test_diagnose import _pairs, scene  # noqa: F401

from schemas.files.outputs import Output
from stages import diagnose

TEST = 2


@pytest.fixture(scope="module")
def answers(scene, tmp_path_factory):  # noqa: F811
    """JSON of a diagnosis of a wrong Sun, and of the same with noise on the images of the test pairs."""
    folder = tmp_path_factory.mktemp("leaks")
    pairs = _pairs(scene, folder, {"sun_azimuth": {"error_deg": 4.0}})
    noisy = folder / "noisy.h5"
    shutil.copy(pairs, noisy)
    with h5py.File(noisy, "r+") as file:
        test = file["split"][...] == TEST
        assert 0 < test.sum() < len(test)
        image = file["image"][...]
        image[test] += np.random.default_rng(3).normal(0, 0.01 * image[test].std(), image[test].shape)
        file["image"][...] = image
    said = []
    for path in (pairs, noisy):
        diagnose.run(path, None, Output(folder / f"{path.stem}_d.h5", json=folder / "d.json", overwrite=True))
        said.append(json.loads((folder / "d.json").read_text()))
    return said


def test_causes_are_learned_without_the_test_pairs(answers):
    plain, noisy = answers
    assert [c["effect"] for c in plain["causes"]] == [c["effect"] for c in noisy["causes"]]
    for one, other in zip(plain["causes"], noisy["causes"], strict=True):
        assert one["parameters"] == other["parameters"]
        assert one["gain_nats"] == other["gain_nats"] and one["held_out_gain_percent"] == other["held_out_gain_percent"]
    assert plain["budget"] == noisy["budget"]


def test_the_score_is_of_the_test_pairs(answers):
    plain, noisy = (a["held_out"] for a in answers)
    assert plain["pairs"] == noisy["pairs"] < answers[0]["data"]["pairs"]
    assert noisy["mse_extended"] > plain["mse_extended"] and noisy["mse_nominal"] > plain["mse_nominal"]


def test_p_tells_what_was_planted_from_what_was_not(answers):
    """p comes from shams: it cannot be 0, nor small for everything."""
    planted = answers[0]["causes"][0]["p_family_wise"]
    assert 0 < planted <= 0.05
