"""The user's path to a diagnosis, command by command: images as files, their Sun from a clock, cameras in orbit, stacks."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from lunargr_cli.main import app
from stages.effects import load_extension

pytestmark = pytest.mark.slow  # a minute; what make demo does as well


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    """(the JSON, diagnosis.h5, pairs.h5) of a simulated scene whose table of images gives a Sun 4 deg off in azimuth."""
    folder = tmp_path_factory.mktemp("scene")
    scene, crops, pairs, found = (folder / f"{n}.h5" for n in ("scene", "crops", "pairs", "diagnosis"))
    hidden = ["--hidden", "sun_azimuth:error_deg=4", "--size-px", 768, "--images", 12, "--seed", 3]
    for command in (
        ["simulate", "-o", folder, *hidden, "--overwrite"],
        ["ingest", folder / "dem.tif", "--images", folder / "images.csv", "--gsd", 5, "-o", scene],
        ["sample", scene, "--stack", "--crop", 64, "--count", 6, "-o", crops],
        ["project", crops, "-o", pairs],
        ["diagnose", pairs, "-o", found, "--json", folder / "diagnosis.json"],
    ):
        out = CliRunner().invoke(app, [str(word) for word in [*command, "-q"]])
        assert out.exit_code == 0, f"{command[0]}: {out.output}"
    return json.loads((folder / "diagnosis.json").read_text()), found, pairs


def test_a_wrong_sun_is_found_from_files(answer):
    said, found, _ = answer
    assert said["verdict"] == "named"
    first = said["causes"][0]
    assert first["effect"] == "sun_azimuth"
    assert first["parameters"]["error_deg"]["value"] > 0 and first["held_out_low"] > 0
    assert load_extension(found)[0].name == "sun_azimuth"


def test_a_wrong_sun_has_its_size(answer):
    said, _, _ = answer
    assert said["causes"][0]["parameters"]["error_deg"]["value"] == pytest.approx(4.0, rel=0.1)


def test_a_wrong_form_of_the_nominal_model_is_no_cause(answer):
    """The simulated ground follows Hapke's model; M2, the default, would have to be given a gain for every image."""
    said, _, _ = answer
    named = {c["effect"] for c in said["causes"]}
    assert not named & {"image_gain", "phase_slope", "limb_darkening", "opposition_surge", "macroscopic_roughness"}


def test_sites_that_images_cover_unequally_are_used(answer):
    said, _, pairs = answer
    with h5py.File(pairs) as file:
        _, images = np.unique(file["site"][...], return_counts=True)
    assert len(set(images)) > 1
    assert said["data"]["images"] > min(images)
