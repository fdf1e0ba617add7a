"""When `diagnose` doubts what it found: values that nothing real has, shapes that are open, measurements that agree by chance."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from stages.diagnose.likelihood.found import Found, beyond_bounds
from stages.diagnose.likelihood.products import Products
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.registration.sunward import sunward
from stages.diagnose.rows.columns import Guise, Plan
from stages.diagnose.search import refine, select
from stages.diagnose.search.doubts import ODD, ORDINARY, doubt, with_ordinary
from stages.diagnose.search.rivals import choose, judge, may_be_another
from stages.diagnose.search.select import Weighed, _hiding, unlikely
from stages.diagnose.search.state import Cause, State
from stages.effects import get_effect
from stages.effects.base import Survey, Trial
from stages.effects.saturation import BINS


def test_shifts_that_albedo_makes_lie_along_the_sun():
    """Of a Lambert surface whose albedo goes with its curvature, shifts are those that a fit of the plain one's slopes finds; real ones lie anywhere."""
    rng = np.random.default_rng(7)
    height = gaussian_filter(rng.normal(size=(120, 120)), 3.0)
    height *= 0.1 / np.hypot(*np.gradient(height)).std()
    down, across = np.gradient(height)
    bend = sum(np.gradient(g, axis=k) for k, g in enumerate((down, across)))
    suns, shifts = [], []
    for azimuth, elevation in np.radians([[100, 15], [250, 50], [310, 25], [20, 60]]):
        sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
        plain = (sun[2] - across * sun[0] + down * sun[1]) / np.sqrt(1 + down**2 + across**2)
        slopes = np.stack([g.ravel() for g in (*np.gradient(plain)[::-1], np.ones_like(plain))], 1)
        change = plain * 0.05 * bend / bend.std()
        shifts.append(np.linalg.lstsq(slopes, change.ravel(), rcond=None)[0][:2])
        suns.append(sun)
    sites = [
        SimpleNamespace(frames=np.arange(4), observation=SimpleNamespace(sun_direction=torch.tensor(np.array(suns))))
    ]
    found = torch.tensor(np.array(shifts))
    assert found.norm(dim=1).max() > 0.3 and sunward(found, sites)
    single = torch.zeros(4, 2)
    single[1] = torch.tensor([2.0, -2.0])
    anywhere = [torch.tensor(rng.normal(size=(4, 2))) for _ in range(200)]
    assert not sunward(single, sites) and sum(sunward(shift, sites) for shift in anywhere) < 6


def _whole(**found):
    """Sums that answer as they are told to; all else of no account."""
    usual = {
        "scattered": np.zeros(0), "sizes": np.ones(4), "places": lambda g: np.array(g.columns), "exclude": lambda g: [],
        "ordinary_places": lambda name: [], "power": lambda places, amount: np.ones(4), "mirrored": lambda g: None,
    }  # fmt: skip
    return SimpleNamespace(**usual | found)


def test_what_is_ordinary_explains_as_much_or_the_rival_is_refused():
    """A pedestal of an ordinary size, and light from terrain that gains next to nothing beside any amount of it; and light that surely does."""
    shade = Guise("dark_bias", get_effect("dark_bias").trials(Survey())[0], (0,))
    light = Guise("interreflection", get_effect("interreflection").trials(Survey())[0], (1,))

    def refused(beside, because):
        both = {g.effect: Found(g.effect, g, np.ones(1), np.ones(1), 9.0) for g in (shade, light)}
        whole = _whole(
            held_out=lambda *rest: np.array([11.0, 10, 12, 9]),
            gains_beside=lambda found, other: np.array(beside, float) * (other.effect == "dark_bias"),
        )
        judge(whole, both["interreflection"])
        return may_be_another(whole, both["interreflection"], both, {"dark_bias": because})

    small = f"{ORDINARY}: iof = 5e-05"
    assert "as much" in refused([1, -1, 2, 0], small)
    assert not refused([1, -1, 2, 0], "the test pairs contradict it")
    assert not refused([1, -1, 2, 0], ODD)
    assert not refused([3, 4, 3, 4], small)


def test_neither_gains_of_few_images_nor_what_they_follow_by_chance_has_a_name():
    """One dependence on the Sun's azimuth and values of each image explain the same: what is likelier by a hundred has its name."""
    turns = Guise("azimuthal_anisotropy", get_effect("azimuthal_anisotropy").trials(Survey())[0], (0,))
    gains = Guise("image_gain", get_effect("image_gain").trials(Survey())[0], (1,), per_frame=True)

    def refused(name, odds):
        both = {g.effect: Found(g.effect, g, np.ones(1), np.ones(1), 9.0, p=0.01) for g in (turns, gains)}
        both["azimuthal_anisotropy"].instead, both["azimuthal_anisotropy"].odds = True, odds
        whole = _whole(
            held_out=lambda places, *rest: np.array([10.0, 12, 9, 11]),
            gains_beside=lambda found, other: np.array([5.0, 6, 5, 6]),
        )
        for found in both.values():
            judge(whole, found)
        return may_be_another(whole, both[name], both, {})

    assert "so few images" in refused("azimuthal_anisotropy", 2.0) and not refused("azimuthal_anisotropy", 6.0)
    assert "do not prove" in refused("image_gain", 2.0) and "do not prove" in refused("image_gain", -2.0)
    assert not refused("image_gain", -6.0)


@pytest.mark.parametrize(("blur", "error", "listed", "left"), [
    (0.48, 0.03, False, "ordinary"), (0.58, 0.03, False, "named"), (0.48, 0.09, False, "named"), (0.48, 0.03, True, "gone"),
])  # fmt: skip
def test_what_is_ordinary_for_sure_beside_a_fault_is_rendered_and_no_name(monkeypatch, blur, error, listed, left):
    """3.4 px of motion had passed for a blur; what is left of that beside it, 0.48 of the 0.6 px2 of any data, took its words away."""

    def cause(name, values, errors):
        cls = get_effect(name)
        guise = Guise(name, cls.trials(Survey())[0], (0,))
        return Cause(cls(values, Survey()), Found(name, guise, np.ones(1), np.ones(1), 9.0), errors=errors)

    optics = cause("psf_blur", {"sigma2_px2": blur}, {"sigma2_px2": error})
    new = cause("dem_smoothing", {"sigma2_px2": 1.5}, {}) if listed else cause("motion_blur", {"sigma2_px2": 0.5}, {})
    state = SimpleNamespace(causes=[optics, new])
    monkeypatch.setattr(select, "refine", lambda state, view: view)
    monkeypatch.setattr(select, "errors_over_images", lambda state, look: None)
    lost = f"with it psf_blur would lose its name ({ORDINARY})", optics
    monkeypatch.setattr(
        select, "doubt_any", lambda state, cause: lost if optics in state.causes and not optics.ordinary else ("", None)
    )
    _, why = select._fit_beside(state, None, new)
    assert (optics in state.causes, optics.ordinary, bool(why)) == {
        "ordinary": (True, True, False), "named": (True, False, True), "gone": (False, False, False),
    }[left]  # fmt: skip


def test_an_echo_explains_more_than_what_lies_on_the_other_side():
    """Optics and relief that the DEM has not are alike before and behind."""
    before, behind = (
        Guise("echo", next(t for t in get_effect("echo").trials(Survey()) if t.fixed["lag_px"] == lag), (k,))
        for k, lag in enumerate((8.0, -8.0))
    )

    def refused(mirrored):
        held = {0: np.array([10.0, 12, 9, 11]), 1: np.array(mirrored, float)}
        found = Found("echo", before, np.ones(1), np.ones(1), 9.0)
        whole = _whole(held_out=lambda places, *rest: held[int(places[0])], mirrored=lambda guise: behind)
        judge(whole, found)
        return may_be_another(whole, found, {"echo": found}, {})

    assert "other side" in refused([11, 10, 12, 9])
    assert not refused([5, 4, 6, 5])
    trials = get_effect("echo").trials(Survey())
    plan = Plan(guises=[Guise("echo", t, (k,)) for k, t in enumerate(trials)])
    of_plan = SimpleNamespace(plan=plan)
    for guise in plan.guises:
        other = Whole.mirrored(of_plan, guise)
        assert other.trial.fixed == {**guise.trial.fixed, "lag_px": -guise.trial.fixed["lag_px"]}
    assert Whole.mirrored(of_plan, Guise("psf_blur", get_effect("psf_blur").trials(Survey())[0], (0,))) is None


def test_values_per_image_do_not_stand_for_what_one_value_for_all_does():
    """Gains of images beside a flat field that was not sure: refused where it gains as much, whatever it was refused for."""
    flat = Guise("column_pattern", get_effect("column_pattern").trials(Survey())[0], (0,))
    gains = Guise("image_gain", get_effect("image_gain").trials(Survey())[0], (1,), per_frame=True)

    def refused(of_gains):
        both = {g.effect: Found(g.effect, g, np.ones(1), np.ones(1), 9.0) for g in (flat, gains)}
        held = {0: np.array([10.0, 12, 9, 11]), 1: np.array(of_gains, float)}
        whole = _whole(
            held_out=lambda places, *rest: held[int(places[0])],
            gains_beside=lambda found, other: np.array([5.0, 6, 5, 6]),
        )
        judge(whole, both["image_gain"])
        return may_be_another(
            whole, both["image_gain"], both, {"column_pattern": "its value is only 1.4 standard errors from zero"}
        )

    assert "do not prove" in refused([11, 10, 12, 9])
    assert not refused([21, 22, 20, 22])


def test_a_sun_that_stands_lower_is_compared_with_a_nonlinearity_without_another_law_beside_either():
    """Beside another form of the law a nonlinearity has nothing left to explain, and a wrong Sun is judged without one."""
    sun, bend = (
        Guise(name, get_effect(name).trials(Survey())[0], (k,))
        for k, name in enumerate(("sun_elevation", "nonlinearity"))
    )

    def refused(of_bend, because=""):
        both = {g.effect: Found(g.effect, g, np.ones(1), np.ones(1), 9.0) for g in (sun, bend)}

        def held_out(places, without, *rest):
            if places[0] == 0:
                return np.array([10.0, 12, 9, 11])
            return np.array(of_bend, float) if 7 in without else np.zeros(4)

        whole = _whole(held_out=held_out, form_places=lambda: np.array([7]))
        judge(whole, both["sun_elevation"])
        return may_be_another(whole, both["sun_elevation"], both, {"nonlinearity": because} if because else {})

    assert "nonlinearity" in refused([13, 15, 12, 15])
    assert not refused([13, 15, 12, 15], ODD)
    assert not refused([9, 13, 8, 12])


def test_what_another_surely_explains_better_has_no_name_though_that_one_is_not_sure():
    """Light from the Earth, whose direction images disagree on, leaves a pedestal a part of what it explains."""
    earth, pedestal = (
        Guise(name, get_effect(name).trials(Survey())[0], columns)
        for name, columns in (("earthshine", (0, 1, 2)), ("dark_bias", (3,)))
    )

    def refused(of_earth, why):
        both = {g.effect: Found(g.effect, g, np.ones(1), np.ones(1), 9.0) for g in (earth, pedestal)}
        held = {0: np.array(of_earth, float), 3: np.array([10.0, 12, 9, 11])}
        whole = _whole(
            held_out=lambda places, *rest, **kind: held[int(places[0])],
            power=lambda *rest: np.ones(4),
            gains_beside=lambda found, other: np.full(4, 10.0),
        )
        judge(whole, both["dark_bias"])
        return may_be_another(whole, both["dark_bias"], both, {"earthshine": why})

    unsure = "other images give it other values: 2.1 errors over images from nothing"
    assert "explains more" in refused([60, 70, 65, 62], unsure)
    assert not refused([12, 11, 10, 12], unsure)
    assert not refused([60, 70, 65, 62], ODD)  # it stands for something that is none of the two


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
        state = SimpleNamespace(impossible=set(), causes=[])
        assert refine._impossible(state, SimpleNamespace(whole=whole, plan=plan)) == (
            {"psf_blur"} if impossible else set()
        )


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


def test_light_from_above_alone_is_a_pedestal():
    """Three values for a direction of light, of which one falls on all ground alike: named where it surely gains more than that one."""

    def named(more):
        sure = [
            Found(name, Guise(name, get_effect(name).trials(Survey())[0], columns), amount, np.ones(len(amount)), 9.0, gains=gains)
            for name, columns, amount, gains in (
                ("earthshine", (0, 1, 2), np.array([0.1, 0.0, 4.0]), np.array([10.0, 12, 9, 11]) + more),
                ("dark_bias", (3,), np.array([4.0]), np.array([10.1, 11, 9, 11])),
            )
        ]  # fmt: skip
        return choose(sure)[0].effect

    assert named(0.2) == "dark_bias"
    assert named(5.0) == "earthshine"


def test_a_fit_that_ends_beside_a_bound_is_nothing_real():
    """An image sharper than its pixels is where the search stops, not what a camera does."""
    for value, possible in ((-0.294, False), (-0.3, False), (0.8, True)):
        cause = Cause(get_effect("psf_blur")({"sigma2_px2": value}), found=None)
        cause.errors = cause.of_given_shape = cause.over_images = {"sigma2_px2": 0.01}
        assert (
            doubt(SimpleNamespace(data=None, frames=8, law_errors=lambda effect: {}), cause).startswith(ODD) != possible
        )


def test_a_blur_below_nothing_hides_no_smooth_dem():
    """A DEM smoothed by 1.9 px2 looks like images sharper than any optics. That blur was refused, and stood beside the DEM all the same."""
    trial = get_effect("psf_blur").trials(Survey())[0]
    at = trial.columns[0]["sigma2_px2"]
    for value, hides in ((-0.7, True), (-0.12, False), (0.4, False)):
        found = Found("psf_blur", Guise("psf_blur", trial, (0,)), np.array([value / at]), np.array([0.06 / at]), 32.0)
        assert _hiding(Weighed({"psf_blur": found}, tried=[], sure=[], rejected={})) == (
            {"psf_blur"} if hides else set()
        )


def test_light_from_below_is_no_earthshine():
    """... which a first estimate must not hide by moving it to the ground; an estimate that is below by chance may stand."""
    trial = get_effect("earthshine").trials(Survey())[0]
    for up, error, impossible in ((-24.0, 0.8, True), (-0.1, 0.4, False), (1.0, 0.4, False)):
        amount, errors = np.array([up, 0.6, -0.3]), np.array([error, 0.05, 0.05])
        found = Found("earthshine", Guise("earthshine", trial, (0, 1, 2)), amount, errors, 40.0)
        assert beyond_bounds(found) == impossible


def test_a_shape_that_is_open_does_not_make_an_effect_nothing():
    """Height and width of a surge trade places: that its width is open does not say that there may be none."""
    cause = Cause(get_effect("opposition_surge")({"B0": 0.6, "h": 0.03}), found=None)
    cause.errors, cause.share_error, cause.share_freedom = {"B0": 0.2, "h": 0.01}, 0.05 / 0.6, 7
    for error, sure in ((0.05, True), (0.2, False)):
        cause.of_given_shape, cause.away = {"B0": error}, 0.6 / error
        assert (doubt(SimpleNamespace(data=None, frames=8, law_errors=lambda effect: {}), cause) == "") == sure


def test_a_vertical_scale_is_known_no_better_than_the_law():
    """Contrast that another law of the ground has passes for it, unless the law is the one that was given."""
    cause = Cause(get_effect("dem_scale")({"relative": -0.12}), found=None)
    cause.errors, cause.away = {"relative": 0.01}, 12.0
    known = SimpleNamespace(data=None, frames=8, law_errors=lambda effect: {})
    unknown = SimpleNamespace(data=None, frames=8, law_errors=lambda effect: effect.law_error)
    assert doubt(known, cause) == ""
    assert "law of the ground, which is not known" in doubt(unknown, cause)
    cause.effect = get_effect("dem_scale")({"relative": -0.3})
    assert doubt(unknown, cause) == ""


def test_values_that_stand_for_each_other_are_sure_together():
    """Each of two cosines is open by itself, their sum is not: the covariance says so, as in any linear fit."""
    cause = Cause(get_effect("column_pattern")({"c1": 0.02, "c2": 0.02}), found=None)
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
    causes = [Cause(get_effect("image_gain")({"gain": gains}, Survey()), found), Cause(shift, found)]
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
        cause = Cause(cls({"sigma2_px2": min(0.5 * amount, 5.0)}), found)
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


@pytest.mark.parametrize(("gain", "rendered"), [(1100.0, True), (900.0, False)])
def test_a_dem_that_is_hardly_too_smooth_is_rendered_where_that_gains_a_hundredth(gain, rendered):
    """A blur that is rendered alone would make up for it."""
    cls = get_effect("dem_smoothing")
    guise = Guise(cls.name, cls.trials(Survey())[0], (0,))
    small = 0.4 * cls.tolerance["sigma2_px2"] / guise.trial.columns[0]["sigma2_px2"]
    found = Found(cls.name, guise, np.array([small]), np.array([0.01]), 9.0, gains=np.full(12, gain / 12))
    view = SimpleNamespace(whole=SimpleNamespace(gram=np.full((1, 1), 1e5)))
    why = unlikely(SimpleNamespace(data=Survey(), frames=1), view, found)
    assert why == "" if rendered else why.startswith(ORDINARY)
