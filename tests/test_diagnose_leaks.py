"""What a diagnosis learns and decides depends on its learning pairs alone. The test pairs give the reported gain, and change nothing else."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from hidden.scene import Layout, Scene
from test_diagnose import _pairs

from schemas.files.outputs import Output
from stages import diagnose
from stages.diagnose.judge.refine import _left, errors_over_images
from stages.diagnose.judge.state import Cause
from stages.diagnose.likelihood.intervals import gain_interval
from stages.diagnose.likelihood.products import Products, Rows, products
from stages.diagnose.likelihood.weigh import Found
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.result.held_out import _wider
from stages.effects import get_effect, load_extension

TEST = 2


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """Pairs with a wrong Sun, in a folder of their own."""
    return _pairs(Scene(Layout(images=8)), tmp_path_factory.mktemp("leaks"), {"sun_azimuth": {"error_deg": 4.0}})


@pytest.fixture(scope="module")
def answer(planted):
    """JSON of their diagnosis, and the state that it ended in."""
    return _diagnosed(planted)


def _diagnosed(pairs):
    said = pairs.with_suffix(".json")
    output = Output(pairs.with_name(f"{pairs.stem}_d.h5"), json=said)
    result = diagnose.run(pairs, None, output, diagnose.Config(most_causes=1))
    return json.loads(said.read_text()), result.state


@pytest.fixture(scope="module")
def noisy(planted):
    """JSON of the diagnosis with noise on the images of the test pairs."""
    pairs = planted.with_name("noisy.h5")
    shutil.copy(planted, pairs)
    with h5py.File(pairs, "r+") as file:
        test = file["split"][...] == TEST
        assert 0 < test.sum() < len(test)
        image = file["image"][...]
        image[test] += np.random.default_rng(3).normal(0, 0.3 * image[test].std(), image[test].shape)
        file["image"][...] = image
    return _diagnosed(pairs)[0]


def test_a_planted_sun_is_named_with_its_size(answer):
    said = answer[0]
    assert said["verdict"] == "named"
    first = said["causes"][0]
    assert first["effect"] == "sun_azimuth" and "sun_azimuth" in first["group"]
    found = first["parameters"]["error_deg"]
    assert found["value"] == pytest.approx(4.0, rel=0.1) and found["unit"] == "degree"


def test_an_answer_is_written_whole_and_its_budget_adds_up(answer, planted):
    said = answer[0]
    assert {"verdict", "causes", "unexplained_fraction", "blind", "held_out", "data", "config"} <= set(said)
    assert said["held_out"]["gain_percent"] > 0  # one place is kept away: no interval
    keys = {"effect", "parameters", "p_family_wise", "gain_nats", "gain_error", "group", "to_separate"}
    assert all(keys <= set(cause) and cause["held_out_low"] > 0 for cause in said["causes"])
    assert sum(said["budget"].values()) == pytest.approx(1.0) and min(said["budget"].values()) >= 0
    assert said["causes"][0]["residual_rms_after"] < said["causes"][0]["residual_rms_before"]
    extension = load_extension(planted.with_name(f"{planted.stem}_d.h5"))
    assert [effect.name for effect in extension] == [cause["effect"] for cause in said["causes"]]


@pytest.mark.slow
def test_the_test_pairs_change_nothing_but_the_reported_gain(answer, noisy):
    """Verdict, names, values and reasons do not move by a bit."""
    assert {k: v for k, v in answer[0].items() if k != "held_out"} == {
        k: v for k, v in noisy.items() if k != "held_out"
    }


@pytest.mark.slow
def test_the_score_is_of_the_test_pairs(answer, noisy):
    plain, other = answer[0]["held_out"], noisy["held_out"]
    assert plain["pairs"] == other["pairs"] < answer[0]["data"]["pairs"]
    assert other["mse_extended"] > plain["mse_extended"] and other["mse_nominal"] > plain["mse_nominal"]


def test_p_tells_what_was_planted_from_what_was_not(answer):
    """p comes from shams: it cannot be 0, nor small for everything."""
    planted = answer[0]["causes"][0]["p_family_wise"]
    assert 0 < planted <= 0.05


def test_the_interval_of_test_pairs_is_that_of_their_images_where_these_differ_more():
    """Twelve pieces of one ground all lose, by what two of its six images have of their own: nobody knows that of other images."""
    images = np.full(6, 100.0), np.array([80.0, 150.0, 90.0, 160.0, 85.0, 95.0])
    over_ground = gain_interval(np.full(12, 50.0), np.full(12, 55.0) + np.linspace(-1, 1, 12))
    assert over_ground[2] < 0
    low, high = _wider(over_ground, images)
    assert low < over_ground[1] and high > 0
    alike = np.full(6, 100.0), np.full(6, 110.0) + np.linspace(-1, 1, 6)
    assert _wider(over_ground, alike)[1] < 0
    nothing = np.zeros(6), np.zeros(6)
    assert _wider(over_ground, nothing) == over_ground[1:]


def test_values_per_image_are_held_by_their_scatter(answer):
    """Where the law hangs on a few images theirs ran away with it: squares fell and fell."""
    state = answer[1]
    view = state.look(["image_gain"], 0)
    guise = next(g for g in view.plan.guises if g.effect == "image_gain")
    found = Found("image_gain", guise, np.zeros(1), np.ones(1), 9.0, spread=0.5)

    def left(gain: float) -> float:
        effect = get_effect("image_gain")({"gain": torch.full((state.frames,), gain)}, state.data)
        return _left(replace(state, causes=[*state.causes, Cause(effect, found, np.zeros(1), np.zeros(1))]), view)

    worth = get_effect("image_gain").strong["gain"]
    assert left(0.3) - left(0.0) == pytest.approx(state.frames * (0.3 / worth / 0.5) ** 2, rel=1e-6)


def test_images_without_the_only_ones_that_tell_of_the_law(answer):
    """What is left says nothing of its coefficients: they do not drift, and nothing is inverted that is nothing."""
    state = answer[1]
    whole = state.look(["image_gain"], 0).whole
    law = [1 + k for k, n in enumerate(whole.plan.shared) if n.startswith("coefficient")]

    def without(unit: Products) -> Products:
        gram = unit.gram.copy()
        gram[law] = gram[:, law] = 0.0
        return replace(unit, gram=gram, level=None)

    dark = Whole([without(u) for u in whole.given], whole.plan, whole.frames)
    assert not any(u.gram[law].any() for u in dark.units)
    assert any((u.gram != g.gram).any() for u, g in zip(dark.units, dark.given, strict=True))
    assert np.isfinite(dark.gram).all()


def test_errors_are_those_over_images_where_these_are_larger(answer):
    state = answer[1]
    cause = state.causes[0]
    kept = dict(cause.over_images), dict(cause.errors)
    errors_over_images(state, state.look(["image_gain"], 0))
    assert 0 < cause.over_images["error_deg"] < 4
    for ground, images in ((1.0, 2.0), (3.0, 2.0)):
        cause.errors, cause.over_images = {"error_deg": ground}, {"error_deg": images}
        assert cause.reported(0.0)["error_deg"][1] == max(ground, images)
    cause.over_images, cause.errors = kept


def test_leaving_out_images_is_leaving_out_their_rows(answer):
    """The Schur complement of the precision gives what the rows of the other images alone give."""
    state = answer[1]
    view = state.look(["image_gain"], 0)
    row = next(r for r in view.rows if len(r.patch.frames) > 2)
    gone = [int(f) for f in row.patch.frames[:2]]
    by_schur = products(row, view.model, view.grid, state.frames, None, [gone])
    kept = torch.tensor([int(f) not in gone for f in row.patch.frames])
    lighter = torch.tensor([int(f) not in gone for f in row.patch.dark_frames], dtype=torch.bool)
    of_patch = {"images": kept, "weight": kept, "scale": kept, "slopes": kept, "level": kept, "frames": kept}
    of_patch |= {"dark_frames": lighter}
    patch = replace(row.patch, **{name: getattr(row.patch, name)[used] for name, used in of_patch.items()})
    of_rows = {"shared": kept, "shared_mean": kept, "own": kept, "own_mean": kept, "shared_dark": lighter}
    fewer = Rows(patch, **{name: getattr(row, name)[:, used] for name, used in of_rows.items()})
    plain = products(fewer, view.model, view.grid, state.frames)
    there = np.isin(by_schur.place, plain.place)
    scale = np.sqrt(np.outer(plain.gram.diagonal(), plain.gram.diagonal())).clip(1e-20)
    without = by_schur.without(0).gram
    assert (np.abs(without[np.ix_(there, there)] - plain.gram) / scale).max() < 2e-5
    assert not without[~there].any()


def test_what_is_known_from_the_ground_left_out_alone_is_nothing_without_it(answer):
    """A column that one piece of ground has to itself gains nothing there, and stops no fit."""
    state = answer[1]
    whole = state.look(["dem_scale", "image_gain"], 0).whole
    (guise,) = [g for g in whole.plan.guises if g.effect == "dem_scale"]
    places = whole.places(guise)
    for unit in whole.units[1:]:
        at = np.isin(unit.place, places)
        unit.gram[at] = unit.gram[:, at] = 0.0
    whole.gram[places], whole.gram[:, places] = 0.0, 0.0
    alone = whole.units[0]
    whole.gram[np.ix_(places, alone.place)] = alone.gram[np.isin(alone.place, places)]
    whole.gram[np.ix_(alone.place, places)] = alone.gram[:, np.isin(alone.place, places)]
    whole.gram[np.ix_(places, places)] *= 1 - 1e-15  # sums differ by rounding
    gains = whole.held_out(places, whole.exclude(guise))
    assert abs(gains[whole.labels[0]]) < 0.01 and np.isfinite(gains).all()
    assert np.isfinite(whole.without_one(places, whole.exclude(guise))).all()
