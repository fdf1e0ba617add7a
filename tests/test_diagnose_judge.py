"""The one judge: what is asked of every claim, in which order, and what an effect stands beside."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.diagnose.judge import refine
from stages.diagnose.judge.claim import Claim, Reason, Rival, decide, injected, more_than_ordinary, of_size
from stages.diagnose.judge.state import Cause, State, _impossible_ordinary
from stages.diagnose.likelihood.columns import Guise, Plan
from stages.diagnose.likelihood.products import Products
from stages.diagnose.likelihood.weigh import Found, beyond_bounds
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.sources.measured import with_ordinary
from stages.effects import get_effect
from stages.effects.base import Survey, Trial
from stages.effects.saturation import BINS

GAINS = np.array([10.0, 12.0, 9.0, 11.0, 10.0, 8.0, 11.0, 12.0])


def claim(**changes) -> Claim:
    """A blur of 1.5 +- 0.1 px2 that gains on every one of eight pieces of ground."""
    blur = get_effect("psf_blur")({"sigma2_px2": 1.5}, Survey())
    given = {"effect": blur, "sizes": {"sigma2_px2": (1.5, 0.1)}, "gains": GAINS, "units": np.ones(8), "away": 15.0}
    return Claim(**given | changes)


def test_a_claim_that_nothing_speaks_against_gets_a_name():
    assert decide(claim()) is None


@pytest.mark.parametrize(("changes", "reason"), [
    ({"odd": "sigma2_px2 = -0.3"}, Reason.IMPOSSIBLE),
    ({"p": 0.06}, Reason.NO_EVIDENCE),
    ({"gains": GAINS - 10.0}, Reason.NO_GAIN),
    ({"gains": GAINS[:2], "units": np.ones(2)}, Reason.NO_GAIN),
    ({"away": 3.9}, Reason.UNSURE),
    ({"away": 4.5, "amounts": 5}, Reason.UNSURE),
    ({"images": 0.9}, Reason.FEW_IMAGES),
    ({"sizes": {"sigma2_px2": (0.62, 0.1)}}, Reason.ORDINARY),
])  # fmt: skip
def test_every_reason_has_its_rule(changes, reason):
    assert decide(claim(**changes)).reason is reason


@pytest.mark.parametrize(("gains", "values", "refused"), [
    (GAINS + 1.0, 1, True),  # it surely gains more
    (GAINS[::-1], 1, False),  # as much, with as many values: a group
    (GAINS[::-1], 0, True),  # as much, with fewer values
    (GAINS - 5.0, 0, False),
    (GAINS * 1.2, 24, False),  # a fifth more, with many values
    (GAINS * 1.4, 24, True),
])  # fmt: skip
def test_a_rival_refuses_where_it_gains_more_or_as_much_with_fewer_values(gains, values, refused):
    found = decide(claim(rivals=[Rival("dem_smoothing", gains, values)]))
    assert (found is not None and found.reason is Reason.RIVAL) == refused
    law = decide(claim(rivals=[Rival("", gains, values)]))
    assert (law is not None and law.reason is Reason.ANOTHER_LAW) == refused


def test_more_than_ordinary_is_two_errors_beyond_it_in_quadrature():
    assert not more_than_ordinary(0.6, 0.0, 0.6) and more_than_ordinary(0.61, 0.0, 0.6)
    assert more_than_ordinary(1.01, 0.4, 0.6) and not more_than_ordinary(0.99, 0.4, 0.6)


def test_a_size_worth_knowing_is_added_to_a_claim_of_a_source():
    """What was measured as nothing would get its name at that size, or not: it is known with the same error."""
    shift = get_effect("misregistration")({}, Survey())
    before = np.full(8, 100.0)
    nothing = of_size(shift, "rms_px", 0.1, 0.02, before, before - 0.01 * GAINS)
    assert decide(nothing).reason is Reason.ORDINARY and decide(injected(nothing, 0.7)) is None
    open_ = of_size(shift, "rms_px", 0.1, 0.3, before, before - 0.01 * GAINS)
    assert decide(injected(open_, 0.7)).reason is Reason.UNSURE


@pytest.mark.parametrize(("value", "possible"), [(-0.294, False), (-0.3, False), (0.8, True)])
def test_a_fit_that_ends_beside_a_bound_is_nothing_real(value, possible):
    """An image sharper than its pixels is where the search stops, not what a camera does."""
    cause = _cause("psf_blur", {"sigma2_px2": value}, 0.01)
    assert (cause.claim(Survey(), 0.0).odd == "") == possible


def test_a_shape_that_is_open_does_not_make_an_effect_nothing():
    """Height and width of a surge trade places: that its width is open does not say that there may be none."""
    for error, sure in ((0.05, True), (0.2, False)):
        cause = _cause("opposition_surge", {"B0": 0.6, "h": 0.03}, error)
        cause.errors |= {"h": 0.05}
        cause.of_given_shape, cause.away = {"B0": error}, 0.6 / error
        assert (decide(cause.claim(Survey(), 0.0)) is None) == sure


def test_a_vertical_scale_is_known_no_better_than_the_law():
    """Contrast that another law of the ground has passes for it, unless the law is the one that was given."""
    cause = _cause("dem_scale", {"relative": -0.12}, 0.01)
    assert decide(cause.claim(Survey(), 0.0)) is None
    assert decide(cause.claim(Survey(), 1.0)).reason is Reason.ORDINARY
    assert decide(_cause("dem_scale", {"relative": -0.3}, 0.01).claim(Survey(), 1.0)) is None


def _cause(name: str, values: dict[str, float], error: float) -> Cause:
    cls = get_effect(name)
    guise = Guise(name, cls.trials(Survey())[0], (0,))
    cause = Cause(cls(values, Survey()), Found(name, guise, np.ones(1), np.ones(1), 9.0, p=0.01), GAINS, np.ones(8))
    cause.errors = dict.fromkeys(values, error)
    cause.of_given_shape = {k: error for k in values if k not in cls.shaped}
    cause.away = max(abs(v) for v in values.values()) / error
    return cause


@pytest.mark.parametrize(
    ("shown", "kept"),
    [
        ([[0, 1, 2]] * 5 + [[3]], {0, 1, 2}),  # one image beside them: its own variance is not known
        ([[k % 8] for k in range(18)], set(range(8))),  # two images show three places and all others two
        ([[k] for k in range(12)], set(range(12))),
    ],
)
def test_images_that_show_little_ground_are_left_out_unless_most_ground_is_shown_by_such(shown, kept):
    sites = [SimpleNamespace(frames=np.array(of), left_out=frozenset()) for of in shown]
    state = SimpleNamespace(
        chains=lambda: sites, frames=12, sites=sites,
        patches=lambda number, chain: [SimpleNamespace(frames=torch.tensor(shown[number]))],
    )  # fmt: skip
    State.leave_out_rare_images(state)
    assert {int(f) for s in sites for k, f in enumerate(s.frames) if k not in s.left_out} == kept


def test_light_from_below_is_no_earthshine():
    """... which a first estimate must not hide by moving it to the ground; an estimate that is below by chance may stand."""
    trial = get_effect("earthshine").trials(Survey())[0]
    for up, error, impossible in ((-24.0, 0.8, True), (-0.1, 0.4, False), (1.0, 0.4, False)):
        amount, errors = np.array([up, 0.6, -0.3]), np.array([error, 0.05, 0.05])
        found = Found("earthshine", Guise("earthshine", trial, (0, 1, 2)), amount, errors, 40.0)
        assert beyond_bounds(found) == impossible


def test_values_that_stand_for_each_other_are_sure_together():
    """Each of two cosines is open by itself, their sum is not: the covariance says so, as in any linear fit."""
    cause = _cause("column_pattern", {"c1": 0.02, "c2": 0.02}, 0.02)
    own = [(0, name, 1.0) for name in ("c1", "c2")]
    alike, alone = np.array([[1.0, -0.99], [-0.99, 1.0]]) * 0.02**2, np.eye(2) * 0.02**2
    for covariance, away in ((alone, math.sqrt(2)), (alike, math.sqrt(2 / 0.01))):
        refine._set_away(SimpleNamespace(causes=[cause]), own, np.full(2, 0.02), covariance)
        assert cause.away == pytest.approx(away)
    refine._set_away(SimpleNamespace(causes=[cause]), own, np.full(2, 0.04), alone)  # as a jackknife has it
    assert cause.away == pytest.approx(math.sqrt(2) / 2)


def test_gains_count_about_their_mean_which_is_the_brightness_of_the_ground():
    """The law and the gains of all images ran off, each against the other: what is told of images is how they differ."""
    gains = torch.tensor([0.0, -0.7, -0.71, -0.72, 0.0])  # the first and the last are not known
    guise = Guise("image_gain", Trial(({"gain": 0.02},)), (0,), per_frame=True)
    found = Found("image_gain", guise, np.ones(5), np.ones(5), 9.0)
    shift = get_effect("misregistration")({"east_px": gains.clone(), "south_px": gains.clone()}, Survey())
    gains_of_images = get_effect("image_gain")({"gain": gains}, Survey())
    causes = [Cause(effect, found, GAINS, GAINS) for effect in (gains_of_images, shift)]
    refine._take_out_means(SimpleNamespace(causes=causes, data=Survey()))
    kept = causes[0].effect.values["gain"]
    assert kept[[0, 4]].tolist() == [0.0, 0.0] and float(kept[1:4].mean()) == pytest.approx(0.0, abs=1e-6)
    assert torch.allclose((1 + kept[1:4]) / (1 + kept[1]), (1 + gains[1:4]) / (1 + gains[1]))
    assert torch.equal(causes[1].effect.values["east_px"], gains)  # where all images lie is no law's


@pytest.mark.parametrize("width", BINS)
def test_a_few_pixels_far_above_all_others_are_no_level(width):
    """... wherever they fall among the bins, the last one among them."""
    bright = torch.cat([torch.linspace(0, 0.5, 3997), torch.tensor([1.0, *2 * [(1 + width) ** 2.5]])])
    assert get_effect("saturation").read_off(bright) is None


def test_a_first_estimate_that_is_extrapolated_is_halved_while_that_leaves_less(monkeypatch):
    """A DEM is sharpened faster than by its first-order column: ten times this is too much, and twice that enough."""
    cls = get_effect("dem_smoothing")
    guise = Guise("dem_smoothing", Trial(({"sigma2_px2": 0.5},)), (0,))
    state = SimpleNamespace(data=Survey(), free_gains=False, fit=lambda: None, again=lambda view, names, model: None)
    view = SimpleNamespace(model=None)
    monkeypatch.setattr(refine, "along", lambda state, view: [])
    for amount, kept in ((8.0, 1.0), (2.0, 1.0), (4.0, 1.0), (40.0, 1.25)):
        found = Found("dem_smoothing", guise, np.array([amount]), np.array([0.1]), 9.0)
        cause = Cause(cls({"sigma2_px2": min(0.5 * amount, 5.0)}), found, GAINS, GAINS)
        cause.effect.held = ("nothing",)
        monkeypatch.setattr(
            refine, "_left", lambda state, now, cause=cause: (float(cause.effect.values["sigma2_px2"]) - 1.1) ** 2
        )
        refine.start_nearer(state, view, cause)
        assert float(cause.effect.values["sigma2_px2"]) == kept
        assert cause.effect.held == ("nothing",)


@pytest.mark.parametrize("name", ["misregistration", "relief_displacement", "line_jitter"])
def test_what_any_data_have_of_a_displacement_is_part_of_what_was_found(name):
    """In quadrature: of 0.5 px found beside an ordinary 0.3 are 0.4 hidden, and 0.1 is what it may be off by."""
    cls = get_effect(name)
    ordinary = cls.tolerance["rms_px"]
    assert with_ordinary(5 / 3 * ordinary, 0.0, cls) == pytest.approx(ordinary / 3)
    assert with_ordinary(100.0, 0.2, cls) == pytest.approx(0.2, rel=1e-2)
    assert with_ordinary(ordinary / 2, 0.0, cls) == pytest.approx(ordinary / 2)  # all of it may be ordinary


def test_optics_that_nothing_real_has_do_not_stand_beside_a_cause():
    """Of blur there may be any ordinary amount; images that are sharper than their pixels by 0.8 px2 there are none."""
    trial = get_effect("psf_blur").trials(Survey())[0]
    guise = Guise("psf_blur", trial, (0,))
    ((_, size),) = trial.columns[0].items()
    rng = np.random.default_rng(7)
    for blur, impossible in ((-0.8, True), (-0.05, False), (0.5, False)):
        column, noise = rng.normal(0, 1, (2, 4000))
        every = np.stack([blur / size * column + noise, column])
        plan = Plan(shared=["psf_blur"], guises=[guise], ordinary={"psf_blur": [0]}, prior={0: 1.2})
        whole = Whole(
            [Products(every @ every.T, np.arange(2), np.zeros((2, 0)), np.zeros(0), 0)], plan, 1, drifting=False
        )
        assert _impossible_ordinary(whole) == (["psf_blur"] if impossible else [])
