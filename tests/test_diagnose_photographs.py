"""`lunargr diagnose` on real photographs, with effects planted into them; part of it needs the reference data."""

from __future__ import annotations

import numpy as np
import pytest
from planted import PLANTS as PHOTOGRAPHED
from planted import plant

from stages import diagnose


@pytest.fixture(scope="module")
def photographs(shared, tmp_path_factory):
    """pairs.h5 of the Apollo 15 frames."""
    from stages import ingest, project, sample

    data = shared / "data" / "apollo15"
    if not (data / "images.csv").is_file():
        pytest.skip("no data/apollo15 beside the oracles")
    folder = tmp_path_factory.mktemp("apollo")
    scene, crops, pairs = (folder / f"{n}.h5" for n in ("scene", "crops", "pairs"))
    ingest.run(data / "gld100_64ppd.tif", data / "images.csv", scene, ingest.Config(gsd=474, crop=48))
    sample.run(scene, crops, sample.Config(stack=True, count=24, tile_m=32000, split=(0.7, 0.1, 0.2)))
    project.run(crops, pairs, project.Config(exact=True))  # what is planted may be brighter than 16 bits reach
    return pairs


def _shift(answer, frame):
    """(east, south) px that a diagnosis gives a frame; 0 where it names none."""
    effect = next((c.effect for c in answer.causes if c.effect.name == "misregistration"), None)
    return np.array([float(effect.values[k][frame]) for k in ("east_px", "south_px")]) if effect else np.zeros(2)


@pytest.mark.slow
def test_a_shift_planted_into_photographs_has_its_size(photographs, tmp_path):
    """... beside the shifts that the frames have: what is planted is the difference."""
    before = diagnose.run(photographs).answer
    after = diagnose.run(plant(photographs, tmp_path / "p.h5", "shift of one frame by 3 px")).answer
    assert np.abs(_shift(after, 0) - _shift(before, 0) - [3.0, 0.0]).max() < 0.3


@pytest.mark.slow
def test_a_smoothed_dem_is_no_optics_that_sharpen(photographs, tmp_path):
    """The images are sharper than the rendering by more than optics can be; beside that nothing would be left for the DEM."""
    said = diagnose.run(plant(photographs, tmp_path / "p.h5", "DEM smoothed by 1.5 px")).answer.to_json()
    found = {c["effect"]: c["parameters"] for c in said["causes"]}["dem_smoothing"]["sigma2_px2"]
    assert abs(found["value"] - 2.25) < 3 * found["error"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["echo of 10 % at 6 px", "blur of 1.2 px", "columns of 3 %"])
def test_what_is_planted_into_photographs_has_its_size(photographs, tmp_path, name):
    """The ground is not of the form of M2: under it an echo of a tenth came out as 4.2 +- 1.1 %."""
    said = diagnose.run(plant(photographs, tmp_path / "p.h5", name)).answer.to_json()
    effect, (parameter, truth) = PHOTOGRAPHED[name]["effect"], PHOTOGRAPHED[name].get("is", ("rms", 0.03))
    found = {c["effect"]: c["parameters"] for c in said["causes"]}[effect][parameter]
    assert abs(found["value"] - truth) < 3 * found["error"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DEM stretched by 1.2", "gamma 0.8"])
def test_what_photographs_cannot_show_is_blind(photographs, tmp_path, name):
    """Beside a gain and an offset of every image, and a law that is known as well as measured ones are."""
    said = diagnose.run(plant(photographs, tmp_path / "p.h5", name)).answer.to_json()
    assert PHOTOGRAPHED[name]["effect"] in said["blind"]


@pytest.mark.slow
def test_the_apollo_frames_were_never_orthorectified(photographs):
    """Real photographs: relief displacement, share 1, and no gain that may be negative."""
    said = diagnose.run(photographs).answer.to_json()
    causes = {c["effect"]: c for c in said["causes"]}
    leaning = causes["relief_displacement"]
    assert leaning["parameters"]["share"]["value"] == pytest.approx(1.0, abs=0.15)
    assert leaning["held_out_gain_percent"] > 30
    assert said["held_out"]["gain_percent"] > 0
    assert all(c["held_out_low"] > 0 for c in said["causes"])
    assert said["verdict"] == "named"
