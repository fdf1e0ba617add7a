"""When `diagnose` doubts what it found: values that nothing real has, shapes that are open, measurements that agree by chance."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hidden.terrain import make_terrain
from scipy.ndimage import gaussian_filter

from stages.diagnose.likelihood.covariance import Covariance, shadow_variance
from stages.diagnose.likelihood.dem_errors import kept_share
from stages.diagnose.likelihood.found import Found, beyond_bounds, interval
from stages.diagnose.likelihood.jackknife import folds, jackknife_error
from stages.diagnose.likelihood.products import Products
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.model.aligned import aligned
from stages.diagnose.registration.sunward import sunward
from stages.diagnose.result.named import _with_ordinary
from stages.diagnose.rows.columns import Guise, Plan
from stages.diagnose.rows.patches import make_grid
from stages.diagnose.search import refine
from stages.diagnose.search.doubts import ODD, ORDINARY, doubt
from stages.diagnose.search.rivals import choose, judge, may_be_another
from stages.diagnose.search.select import Weighed, _hiding, unlikely
from stages.diagnose.search.state import Cause, State
from stages.diagnose.settings import FOLDS
from stages.effects import get_effect
from stages.effects.base import Survey, Trial
from stages.effects.filters import gaussian, seams
from stages.effects.saturation import BINS
from stages.physics.formation.resampling import displace


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


@pytest.mark.parametrize("size", [0.02, 0.2])
def test_the_error_of_an_rms_is_its_scatter_where_values_are_drawn_as_they_are_open(size):
    rng = np.random.default_rng(8)
    mean, mixed = size * rng.normal(size=6), 0.01 * rng.normal(size=(6, 6))
    drawn = rng.multivariate_normal(mean, mixed @ mixed.T, 20_000)
    squares = np.square(drawn).mean(1)
    rms = math.sqrt(squares.mean())
    scatter = float(squares.std()) / (2 * rms)
    assert refine._error_of_rms(mean, mixed @ mixed.T, rms, 6) == pytest.approx(scatter, rel=0.05)


def test_a_seam_of_a_dem_is_not_sharpened():
    """Pieces are put together after they were smoothed: sharpened, a step would be a ridge that no image shows."""
    for seed in range(5):
        fine = make_terrain(np.random.default_rng(seed), 97, 2.0, 8.0)[:96, :96]
        smooth = gaussian_filter(fine, 1.2, mode="nearest")
        plain = torch.from_numpy(smooth).float()[None]
        assert float(seams(plain).abs().max()) == 0  # craters and their rims are none
        step = torch.zeros(1, 96, 96)
        step[:, 50:] += 0.4
        step[:, :, 30:] -= 0.3
        assert torch.allclose(seams(plain + step), step, atol=0.05)
        sharp = {}
        for name, z in (("plain", plain), ("seamed", plain + step)):
            state = SimpleNamespace(elevation=z.clone())
            get_effect("dem_smoothing")({"sigma2_px2": 1.44}).apply(state)
            sharp[name] = state.elevation
        assert torch.allclose(sharp["seamed"] - step, sharp["plain"], atol=0.06)


def test_what_of_a_dem_may_be_errors_is_what_images_show_beside_it():
    """Slopes that are white noise of a known variance: the share that is relief is one less the ratio of variances, wave by wave."""
    grid = make_grid(48, 48)
    rng = np.random.default_rng(3)
    waves = torch.zeros(grid.annuli, dtype=torch.float64)
    model = Covariance(waves, waves.clone(), torch.ones(grid.annuli, 1), 0.0, 0.0, 1.0, radius=grid.radius.tolist())
    model.relief[2:] = 0.01**2 / 4
    model.relief[-1] = 1.0
    chains, patches = [], []
    for k in range(40):
        slopes = [torch.from_numpy(rng.normal(0, 0.01, (1, 48, 48))).float() for _ in range(2)]
        chains.append(SimpleNamespace(state=SimpleNamespace(slopes=slopes)))
        patches.append(SimpleNamespace(site=k, rows=slice(0, 48), columns=slice(0, 48)))
    kept = kept_share(chains, patches, grid, model)(2 * torch.pi * grid.radius)
    assert kept[:2].tolist() == [1.0, 1.0]
    assert kept[2:-1].numpy() == pytest.approx(np.full(grid.annuli - 3, 0.75), abs=0.04)
    assert kept[-1] < 1e-6  # all of it


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


def _shadows(values, light=None, cells=1):
    """The model of means in the deep shadow of one image, so many cells on each piece of ground."""
    model = Covariance.white(1, 1)
    pieces = torch.tensor(values, dtype=torch.float64).split(cells)
    kinds = torch.ones(1, len(values)) if light is None else torch.tensor(light)[None]
    patches = [
        SimpleNamespace(number=k, dark_frames=torch.zeros(len(v), dtype=torch.long)) for k, v in enumerate(pieces)
    ]
    shadow_variance(model, patches, pieces, kinds.split(cells, 1))
    return model


def test_scatter_of_shadows_is_what_no_light_explains():
    """As far as they lie from nothing where there are too few to scatter, as they scatter where there are many."""
    assert _shadows([]).dark == 1.0
    assert _shadows([-0.0054]).dark_piece ** 0.5 > 0.005
    many = np.random.default_rng(1).normal(0.05, 0.01, 400)
    assert _shadows(many.tolist()).dark_piece ** 0.5 == pytest.approx(0.01, rel=0.15)
    # light that falls on one shadow more than on another is no scatter
    walls = np.random.default_rng(2).uniform(0, 0.1, 400)
    assert _shadows((many + walls - 0.05).tolist(), walls.tolist()).dark_piece ** 0.5 == pytest.approx(0.01, rel=0.15)


def test_pieces_of_ground_differ_as_their_cells_do_at_least():
    """Relief that the DEM has not lights a piece's cells together; pieces that agree by chance are not exact."""
    rng = np.random.default_rng(3)
    alone, piece = rng.normal(0, 0.01, (100, 9)), rng.normal(0, 0.03, (100, 1))
    together = _shadows((alone + piece).flatten().tolist(), cells=9)
    assert together.dark**0.5 == pytest.approx(0.01, rel=0.15) and together.dark_piece**0.5 == pytest.approx(
        0.03, rel=0.2
    )
    same = _shadows((alone[:2] - alone[:2].mean(1, keepdims=True)).flatten().tolist(), cells=9)
    assert same.dark_piece >= same.dark > 1e-5
    # the nine cells of a piece say little more than one does
    root = together.dark_root(SimpleNamespace(dark_frames=torch.zeros(9, dtype=torch.long)))
    level = torch.linalg.solve_triangular(root, torch.ones(9, 1, dtype=torch.float64), upper=False)
    assert float(level.square().sum()) == pytest.approx(1 / (together.dark_piece + together.dark / 9), rel=1e-6)


def test_gains_in_few_shadows_are_judged_by_the_ground_that_shows_them():
    """Where most ground has nothing to gain, the rest is compared with itself; one piece of ground says nothing of others."""
    gains, shown = np.array([20.0, 22, 18, 21, *np.zeros(12)]), np.array([1.0, 1, 1, 1, *np.zeros(12)])
    assert interval(gains, shown)[0] > 70 > interval(gains)[0]
    assert interval(gains[:3], np.array([1.0, 0.01, 0.01]))[0] == -math.inf


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


def test_sharpening_goes_on_smoothly():
    """Waves that stop growing one after the other would make a fit stop at the first of them."""
    relief = torch.from_numpy(np.random.default_rng(4).normal(0, 1, (1, 64, 64)).cumsum(1).cumsum(2))
    sizes = np.linspace(0.5, 1.0, 26)
    heights = torch.stack([gaussian(relief, -float(s), slopes=True)[0] for s in sizes])
    first, second = heights.diff(dim=0), heights.diff(n=2, dim=0)
    assert float(second.square().mean().sqrt() / first.square().mean().sqrt()) < 0.15  # 0.33 with a sudden end
    assert torch.equal(gaussian(relief, 0.0, slopes=True).round(decimals=6), relief.round(decimals=6))


@pytest.mark.parametrize("width", BINS)
def test_a_few_pixels_far_above_all_others_are_no_level(width):
    """... wherever they fall among the bins, the last one among them."""
    bright = torch.cat([torch.linspace(0, 0.5, 3997), torch.tensor([1.0, *2 * [(1 + width) ** 2.5]])])
    assert get_effect("saturation").read_off(bright) is None


def test_jackknife_of_units_that_tell_unequally_much() -> None:
    """Means of values of known, unequal precision scatter by as much as it says; where one alone knows a value, leaving it out shows nothing."""
    rng = np.random.default_rng(0)
    precision = np.array([5, 1, 1, 1, 0.5, 0.5, 0.5, 0.5])
    values = rng.normal(0, precision**-0.5, (4000, 8))
    means = (values * precision).sum(1) / precision.sum()
    rest = precision.sum() - precision
    without = ((values * precision).sum(1, keepdims=True) - values * precision) / rest
    variance = np.mean([jackknife_error(w, rest) ** 2 for w in without])
    assert 0.75 < variance / means.var() < 1.15
    assert jackknife_error(np.array([900.0, 0.0, 0.0]), np.array([1e-6, 2.0, 2.0])) < 0.01


def test_images_that_are_laid_elsewhere_keep_their_noise() -> None:
    """Or those that moved by half a pixel would seem better than others; and what is not known does not ring into its neighbours."""
    noise = torch.randn(2, 96, 96, generator=torch.manual_seed(3))
    everywhere = torch.ones(2, 96, 96, dtype=torch.bool)
    half = torch.full((2, 96, 96), 0.5)
    moved, valid = aligned(noise, everywhere, half, half)
    quick, _ = aligned(noise, everywhere, half, half, displace)
    power = [float(z[valid].square().mean()) for z in (noise, moved, quick)]
    assert power[1] > 0.65 * power[0] and power[2] < 0.5 * power[0]
    wave = torch.cos(2 * math.pi * 0.3 * (torch.arange(96.0) + 0.2)).expand(2, 96, 96)
    moved, _ = aligned(wave, everywhere, torch.full((2, 96, 96), 0.3), 0 * half)
    expected = torch.cos(2 * math.pi * 0.3 * (torch.arange(96.0) - 0.1))
    assert (moved - expected)[:, 8:-8, 8:-8].abs().max() < 0.03
    flat, hole = torch.full((2, 96, 96), 5.0), everywhere.clone()
    hole[:, 40:50, 30:60] = False
    moved, valid = aligned(flat * hole, hole, half, half)
    assert not valid[:, 40:50, 31:60].any() and (moved[valid] - 5.0).abs().max() < 1e-4


@pytest.mark.parametrize("period", [2, 3, 4, 6, 8, 12])
def test_images_that_come_back_every_so_many_grounds_are_known_from_other_parts(period):
    """Else their own gains and shifts would be known from no ground but that which they are judged on."""
    alone = []
    for count in range(2 * period, 6 * period):
        part = folds(count)
        assert sorted(np.bincount(part))[0] >= count // FOLDS
        alone += [len(set(part[k::period])) == 1 for k in range(period)]
    assert np.mean(alone) < 0.15


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
    assert _with_ordinary(5 / 3 * ordinary, 0.0, cls) == pytest.approx(ordinary / 3)
    assert _with_ordinary(100.0, 0.2, cls) == pytest.approx(0.2, rel=1e-2)
    assert _with_ordinary(ordinary / 2, 0.0, cls) == pytest.approx(ordinary / 2)  # all of it may be ordinary


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
