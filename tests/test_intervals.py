"""How often 95 % intervals hold the truth, by simulation with a known answer; pairing; units; training runs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import special, stats

from stages.common.intervals import (
    ERROR,
    LOGIT,
    choose_units,
    effective_units,
    gain_interval,
    join,
    ratio_interval,
    run_variance,
    student_quantile,
    two_sided_p,
    unseen_quantile,
)

TRIALS = 2500
# Squared errors per tile of the embedded scene scatter by about 70 % and lean to the right; pairs per tile differ.
LAWS = {
    "gamma": lambda rng, n: rng.gamma(2, 1 / 2, n),
    "lognormal": lambda rng, n: rng.lognormal(-(0.65**2) / 2, 0.65, n),
    "mild": lambda rng, n: rng.gamma(8, 1 / 8, n),
}
TRIED = ["lognormal", *(pytest.param(law, marks=pytest.mark.slow) for law in ("gamma", "mild"))]


def _ground(rng, units, law):
    """(squared errors, pixels, unit) of crops: every tile has its own error and its own number of crops."""
    crops = rng.integers(8, 25, units)
    unit = np.repeat(np.arange(units), crops)
    pixels = np.full(len(unit), 1000.0)
    return LAWS[law](rng, units)[unit] * pixels * rng.gamma(40, 1 / 40, len(unit)), pixels, unit


@pytest.mark.parametrize("law", TRIED)
@pytest.mark.parametrize("units", [4, 7, 10, 40])
def test_intervals_of_errors_cover_as_often_as_they_say(units, law):
    rng = np.random.default_rng([units, len(law), 2])
    held = 0
    for _ in range(TRIALS):
        total, pixels, unit = _ground(rng, units, law)
        found = ratio_interval(total, pixels, unit, ERROR)
        held += found.low <= 1.0 <= found.high
    assert 0.93 <= held / TRIALS <= 0.97


@pytest.mark.parametrize("law", TRIED)
@pytest.mark.parametrize("units", [4, 7, 10, 40])
def test_intervals_of_gains_cover_as_often_as_they_say(units, law):
    rng = np.random.default_rng([units, len(law), 1])
    held = 0
    for _ in range(TRIALS):
        other, _, unit = _ground(rng, units, law)
        ours = 0.8 * other * rng.lognormal(-(0.3**2) / 2, 0.3, units)[unit]  # 20 % better, by tile more or less
        found = gain_interval(ours, other, unit)
        held += found.low <= 20.0 <= found.high
    assert 0.93 <= held / TRIALS <= 0.97


def test_the_spread_over_training_runs_is_part_of_the_interval():
    """Three runs that differ by 10 %, on ten tiles: without their spread the interval would hold the truth too rarely."""
    rng = np.random.default_rng(3)
    held = without = 0
    for _ in range(TRIALS):
        total, pixels, unit = _ground(rng, 10, "mild")
        runs = total * (1 + 0.2 * rng.normal(size=3))[:, None]
        found, blind = (ratio_interval(r, pixels, unit, ERROR) for r in (runs, runs.mean(0)))
        held += found.low <= 1.0 <= found.high
        without += blind.low <= 1.0 <= blind.high
    assert 0.93 <= held / TRIALS <= 0.98
    assert without / TRIALS < 0.9


@pytest.mark.parametrize("units", [4, 10, 40])
def test_intervals_of_shares_cover_as_often_as_they_say(units):
    rng = np.random.default_rng([units, 5])
    held = 0
    for _ in range(TRIALS):
        share = rng.beta(6, 6, units)  # half of the matches are right, on some tiles more
        count = rng.integers(300, 600, units)
        found = ratio_interval(rng.binomial(count, share), count, np.arange(units), LOGIT)
        held += found.low <= 0.5 <= found.high
    assert 0.93 <= held / TRIALS <= 0.97


def test_the_old_percentiles_cover_far_less():
    """What the intervals replace: resampled tiles, their 2.5 and 97.5 % quantiles."""
    rng = np.random.default_rng(8)
    held = 0
    for _ in range(400):
        total, pixels, unit = _ground(rng, 7, "lognormal")
        weights = rng.multinomial(7, np.full(7, 1 / 7), size=400)
        draws = (weights @ np.bincount(unit, total)) / (weights @ np.bincount(unit, pixels))
        low, high = np.quantile(draws, (0.025, 0.975))
        held += low <= 1.0 <= high
    assert held / 400 < 0.88


def test_a_gain_is_paired():
    """Tiles differ tenfold in both rows alike: what remains uncertain is the ratio, which is the same everywhere."""
    rng = np.random.default_rng(0)
    unit = np.repeat(np.arange(8), 5)
    other = rng.lognormal(0, 1, 8)[unit]
    found = gain_interval(0.7 * other, other, unit)
    assert found.value == pytest.approx(30) and found.high - found.low < 1e-6
    worse = gain_interval(other, 0.7 * other, unit)
    assert worse.high < 0


def test_crops_of_a_tile_are_one_witness():
    rng = np.random.default_rng(1)
    values = rng.gamma(8, 1 / 8, 20)
    few = ratio_interval(values, np.ones(20), np.arange(20))
    many = ratio_interval(np.repeat(values, 50), np.ones(1000), np.repeat(np.arange(20), 50))
    assert (many.low, many.value, many.high) == pytest.approx((few.low, few.value, few.high))


def test_the_jackknife_of_a_plain_mean_is_the_textbook_interval():
    values = np.random.default_rng(2).normal(5, 1, 12)
    found = ratio_interval(values, np.ones(12), np.arange(12))
    reach = stats.t.ppf(0.975, 11) * values.std(ddof=1) / math.sqrt(12)
    assert (found.low, found.high) == pytest.approx((values.mean() - reach, values.mean() + reach))


def test_unequal_units_count_as_fewer():
    assert effective_units(np.ones(7)) == pytest.approx(7)
    assert effective_units(np.array([10.0, 1.0, 1.0])) == pytest.approx(144 / 102)


def test_one_unit_or_nothing_known_gives_no_interval():
    for total, unit in ((np.ones(5), np.zeros(5)), (np.full(5, np.nan), np.arange(5))):
        found = ratio_interval(total, np.ones(5), unit)
        assert math.isnan(found.low) and math.isnan(found.high)


def test_crops_that_are_not_known_do_not_count():
    total, unit = np.array([1.0, np.nan, 2.0, 3.0]), np.arange(4)
    kept = np.isfinite(total)
    assert ratio_interval(total, np.ones(4), unit) == ratio_interval(total[kept], np.ones(3), unit[kept])


def test_an_error_of_nothing_has_an_interval_of_nothing():
    assert ratio_interval(np.zeros(6), np.ones(6), np.arange(6), ERROR).high == 0
    assert gain_interval(np.zeros(6), np.ones(6), np.arange(6)).low == 100


def test_sites_stand_in_where_there_is_one_tile():
    tile, site = np.zeros(4), np.array([1, 1, 2, 2])
    assert choose_units(tile, site)[1] == "site" and choose_units(site, site)[1] == "tile"


def test_joined_variances_have_welch_s_freedom():
    a, b = run_variance([1.0, 2.0, 4.0]), run_variance([1.0, 1.5])
    found = join([a, b])
    welch = (a.value + b.value) ** 2 / (a.value**2 / 2 + b.value**2 / 1)
    assert (found.value, found.freedom) == pytest.approx((a.value + b.value, welch))
    assert join([a, run_variance([1.0])]).freedom == 0


def test_student_of_one_degree_is_cauchy():
    assert student_quantile(1) == pytest.approx(math.tan(0.475 * math.pi))
    assert two_sided_p(1.0, 1) == pytest.approx(0.5)


def test_the_variance_of_a_mean_of_runs_divides_by_one_less():
    found = run_variance([1.0, 2.0, 4.0])
    assert found.value == pytest.approx(((4 / 3) ** 2 + (1 / 3) ** 2 + (5 / 3) ** 2) / 2 / 3) and found.freedom == 2


@pytest.mark.parametrize("units", [4, 9])
def test_the_quantile_for_an_unseen_unit_holds_as_often_as_it_says(units):
    """Errors whose size differs from unit to unit by half; the next unit, drawn alike, against the law that drew it."""
    rng = np.random.default_rng(units)
    plain, unseen = [], []
    for _ in range(1000):
        size = rng.lognormal(0, 0.5, units + 1)
        values, unit = np.abs(rng.normal(size=(units, 200)) * size[:units, None]), np.repeat(np.arange(units), 200)
        for held, quantile in (
            (plain, np.quantile(values, 0.95)),
            (unseen, unseen_quantile(values.ravel(), unit, 0.95)),
        ):
            held.append(special.erf(quantile / size[units] / math.sqrt(2)))
    assert np.mean(unseen) == pytest.approx(0.95, abs=0.01)
    assert np.mean(plain) < np.mean(unseen) - 0.005


def test_a_single_unit_has_the_plain_quantile(rng):
    values = rng.exponential(size=1000)
    assert unseen_quantile(values, np.zeros(1000), 0.95) == np.quantile(values, 0.95)
