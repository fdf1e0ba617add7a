"""Metrics, matching and coverage against closed forms and scipy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from stages.evaluate.coverage import count_within, gaussian_widths, shares
from stages.evaluate.metrics import psnr, squared_error, ssim
from stages.physics.formation.radiometry import full_scale, match_crops


def test_squared_error_counts_valid_pixels_only():
    measured, rendered = np.zeros((2, 4, 4)), np.full((2, 4, 4), 0.5)
    valid = np.ones((2, 4, 4), bool)
    valid[1, :, 0] = False
    rendered[1, :, 0] = np.nan
    assert squared_error(measured, rendered, valid) == pytest.approx([16 * 0.25, 12 * 0.25])


def test_psnr_of_known_errors():
    assert psnr(1e-4) == pytest.approx(40.0)
    assert psnr(1e-4, 0.1) == pytest.approx(20.0)
    assert psnr(0.0) == np.inf


def test_ssim_equals_the_definition_with_scipy_windows(rng):
    x = gaussian_filter(rng.normal(size=(48, 60)), 2.0) + 0.3
    y = 0.8 * x + 0.05 * rng.normal(size=x.shape)
    data_range = float(np.ptp(x))
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2

    def window(field):
        return gaussian_filter(field, 1.5, truncate=5 / 1.5)[5:-5, 5:-5]

    mx, my = window(x), window(y)
    vx, vy, cxy = window(x * x) - mx**2, window(y * y) - my**2, window(x * y) - mx * my
    expected = ((2 * mx * my + c1) * (2 * cxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean()
    assert ssim(x, y, np.ones(x.shape, bool), data_range) == pytest.approx(expected, rel=1e-9)


def test_ssim_of_constant_images_is_the_luminance_term():
    x, y, valid = np.full((20, 20), 0.4), np.full((20, 20), 0.6), np.ones((20, 20), bool)
    expected = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    assert ssim(x, y, valid, 1.0) == pytest.approx(expected, rel=1e-12)


def test_ssim_ignores_what_lies_under_the_mask(rng):
    x = rng.normal(size=(40, 40))
    y = x + 0.1 * rng.normal(size=x.shape)
    valid = np.ones(x.shape, bool)
    valid[:12, :20] = False
    spoiled = y.copy()
    spoiled[~valid] = 1e6
    assert ssim(x, spoiled, valid, 1.0) == ssim(x, y, valid, 1.0)
    assert ssim(x, y, valid, 1.0) != ssim(x, y, np.ones_like(valid), 1.0)
    assert ssim(x, x, valid, 1.0) == pytest.approx(1.0, abs=1e-12)
    assert np.isnan(ssim(x, y, np.zeros_like(valid), 1.0))


def _crop(rng, count=3):
    rendered = torch.from_numpy(rng.uniform(0.05, 0.2, (count, 16, 16)))
    valid = torch.from_numpy(rng.uniform(size=(count, 16, 16)) > 0.2)
    return rendered, valid


@pytest.mark.parametrize("how", ["gain_offset", "minmax"])
def test_matching_undoes_a_planted_gain_and_offset(rng, how):
    rendered, valid = _crop(rng)
    gain = torch.tensor([0.5, 2.0, 9.0], dtype=torch.float64)[:, None, None]
    measured = torch.where(valid, gain * rendered + 0.3, -99.0)
    matched = match_crops(rendered, measured, valid, how)
    assert torch.allclose(matched[valid], measured[valid], atol=1e-12)


def test_gain_matching_is_the_least_squares_gain(rng):
    rendered, valid = _crop(rng, 1)
    measured = torch.from_numpy(rng.uniform(0, 0.3, (1, 16, 16)))
    expected = np.linalg.lstsq(rendered[valid].numpy()[:, None], measured[valid].numpy(), rcond=None)[0][0]
    matched = match_crops(rendered, measured, valid, "gain")
    assert float((matched / rendered)[0, 0, 0]) == pytest.approx(expected, rel=1e-12)


def test_gain_offset_matching_is_linear_regression(rng):
    rendered, valid = _crop(rng, 1)
    measured = torch.from_numpy(rng.uniform(0, 0.3, (1, 16, 16)))
    slope, intercept = np.polyfit(rendered[valid].numpy(), measured[valid].numpy(), 1)
    matched = match_crops(rendered, measured, valid, "gain_offset")
    assert torch.allclose(matched, slope * rendered + intercept, atol=1e-12)


def test_minmax_matching_takes_range_and_mean(rng):
    rendered, valid = _crop(rng, 1)
    measured = torch.from_numpy(rng.gamma(2.0, 0.05, (1, 16, 16)))
    matched = match_crops(rendered, measured, valid, "minmax")[valid]
    assert float(matched.mean()) == pytest.approx(float(measured[valid].mean()), rel=1e-12)
    assert float(matched.max() - matched.min()) == pytest.approx(
        float(measured[valid].max() - measured[valid].min()), rel=1e-12
    )


def test_a_constant_rendering_is_matched_by_the_mean():
    rendered, valid = torch.zeros(1, 8, 8), torch.ones(1, 8, 8, dtype=torch.bool)
    measured = torch.linspace(0, 1, 64).reshape(1, 8, 8)
    for how in ("minmax", "gain_offset"):
        assert torch.allclose(match_crops(rendered, measured, valid, how), torch.full((1, 8, 8), 0.5))


@pytest.mark.parametrize(
    ("largest", "expected"), [(0.4, 1), (17, 255), (255, 255), (255.006, 255), (256, 511), (4000, 4095)]
)
def test_full_scale_of_digital_numbers(largest, expected):
    assert full_scale(largest) == expected


def coverage(measured, predicted, std, incidence):
    return shares(count_within(np.abs(measured - predicted), gaussian_widths(std), incidence))


def test_coverage_of_honest_and_of_half_as_large_deviations(rng):
    std = rng.uniform(0.002, 0.02, 200_000)
    predicted = rng.uniform(0.05, 0.2, std.size)
    measured = predicted + std * rng.normal(size=std.size)
    incidence = np.radians(rng.uniform(0, 90, std.size))
    honest = coverage(measured, predicted, std, incidence)
    assert honest["pixels"] == std.size
    assert (honest["68"], honest["95"]) == pytest.approx((68, 95), abs=0.3)
    for band in honest["by_incidence"]:
        assert band["95"] == pytest.approx(95, abs=0.5)
    bold = np.where(np.degrees(incidence) > 60, std / 2, std)
    bands = coverage(measured, predicted, bold, incidence)["by_incidence"]
    steep = [b["95"] for b in bands if b["incidence_low_deg"] >= 60]
    assert steep == pytest.approx([67.3] * len(steep), abs=1)  # P(|z| < .98)
    assert bands[0]["95"] == pytest.approx(95, abs=0.5)


def test_pixels_without_a_deviation_do_not_count():
    values = np.full(4, 0.1)
    std = np.array([0.01, np.nan, 0.01, 0.01])
    found = coverage(values, values + [0.0, 0.0, 0.015, 0.03], std, np.zeros(4))
    assert found["pixels"] == 3
    assert (found["68"], found["95"]) == pytest.approx((100 / 3, 200 / 3))
    assert found["by_incidence"][-1] == {
        "incidence_low_deg": 75.0, "incidence_high_deg": 90.0, "pixels": 0, "68": None, "95": None,
    }  # fmt: skip
