"""Registration: planted shifts come back, also through noise, albedo and holes; poor evidence is refused."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.errors import GeometryError
from stages.physics.images.fit_displacement import fit_field
from stages.physics.images.registration import Shift, block_shift, prepare

FINE = 4  # the scene is made this much finer than its images, so that a shift of 1/4 px needs no interpolation
SIZE = 128


def estimate_shift(image, rendering, valid=None, max_shift=8.0):
    """The one shift of the whole picture."""
    pictures = prepare(image, rendering, valid)
    return block_shift(pictures, (0, 0, *pictures.image.shape), max_shift)


def fractal(rng, n, beta):
    f = np.fft.fftfreq(n)
    k = np.hypot(f[:, None], f[None])
    k[0, 0] = 1
    spectrum = np.fft.fft2(rng.standard_normal((n, n))) * k ** (-beta / 2)
    spectrum[0, 0] = 0
    return np.fft.ifft2(spectrum).real


def shade(height, sun):
    south, east = np.gradient(height)
    return np.clip((sun[2] - east * sun[0] + south * sun[1]) / np.sqrt(1 + east**2 + south**2), 0, None)


@pytest.fixture(scope="module")
def scene():
    """(picture of fine pixels with albedo and another reflectance, coarse rendering with neither)."""
    rng = np.random.default_rng(7)
    n = (SIZE + 32) * FINE
    height = fractal(rng, n, 3.4)
    height *= 0.15 / np.gradient(height)[0].std()
    sun = np.array([np.cos(np.radians(25)), 0.2, np.sin(np.radians(25))])
    sun /= np.linalg.norm(sun)
    albedo = fractal(rng, n, 2.2)
    mu0 = shade(height, sun)
    picture = (1 + 0.1 * albedo / albedo.std()) * mu0 / (mu0 + 0.9)
    return picture, shade(coarse(height, 0, 0) / FINE, sun)


def coarse(fine, dx, dy):
    """Area means of the middle, displaced by (dx, dy) coarse pixels."""
    margin = 16 * FINE
    r, c = margin - round(dy * FINE), margin - round(dx * FINE)
    return fine[r : r + SIZE * FINE, c : c + SIZE * FINE].reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))


@pytest.mark.parametrize("planted", [(0, 0), (0.25, 0.5), (1.25, -1.75), (-4, 4), (3.75, 0.75), (-2.25, -3.5)])
def test_planted_shifts_come_back(scene, rng, planted):
    picture, rendering = scene
    image = coarse(picture, *planted)
    image = 40 + 300 * image + rng.normal(0, 0.02 * 300 * image.mean(), image.shape)  # unknown gain and offset, noise
    valid = np.ones(image.shape, bool)
    valid[:40, :30] = valid[90:, 100:] = False
    image[~valid] = np.nan
    found = estimate_shift(image, rendering, valid)
    assert found.accepted, found.refused
    assert (found.dx, found.dy) == (pytest.approx(planted[0], abs=0.1), pytest.approx(planted[1], abs=0.1))
    assert found.sigma < 0.3 and 0.3 < found.quality <= 1


def test_the_standard_error_is_honest(scene, rng):
    """Over many regions errors are of the size that sigma says."""
    picture, rendering = scene
    ratios = []
    for planted in ((0.5, 0.25), (-1.25, 2.0), (2.5, -0.75)):
        image = coarse(picture, *planted)
        for r in range(0, SIZE, 64):
            for c in range(0, SIZE, 64):
                part = np.s_[r : r + 64, c : c + 64]
                found = estimate_shift(image[part] + rng.normal(0, 0.01, (64, 64)), rendering[part])
                if found.accepted:
                    ratios.append(max(abs(found.dx - planted[0]), abs(found.dy - planted[1])) / found.sigma)
    assert len(ratios) >= 8
    assert np.median(ratios) < 2


def test_poor_evidence_is_refused(scene, rng):
    _, rendering = scene
    noise = rng.random(rendering.shape)
    assert not estimate_shift(noise, rendering).accepted
    assert "no structure" in estimate_shift(np.ones_like(rendering), rendering).refused
    few = np.zeros(rendering.shape, bool)
    few[:10, :10] = True
    assert "100 pixels" in estimate_shift(rendering, rendering, few).refused
    assert not estimate_shift(-rendering, rendering).accepted  # a negative
    stripes = np.tile(np.sin(np.arange(SIZE) / 2), (SIZE, 1))
    assert not estimate_shift(stripes, stripes + 0.01 * noise).accepted  # slides along itself
    assert estimate_shift(noise, rendering).quality == 0


def test_shifts_beyond_the_search_are_refused(scene):
    picture, rendering = scene
    found = estimate_shift(coarse(picture, 12, 0), rendering, max_shift=6)
    assert not found.accepted
    assert estimate_shift(coarse(picture, 12, 0), rendering, max_shift=14).dx == pytest.approx(12, abs=0.1)


def test_shapes_must_agree():
    with pytest.raises(GeometryError, match="one shape"):
        estimate_shift(np.zeros((64, 64)), np.zeros((64, 65)))


def regions(rng, n, dx, dy, noise=0.1):
    row, col = rng.uniform(0, 1000, (2, n))
    shifts = [
        Shift(float(dx(r, c) + rng.normal(0, noise)), float(dy(r, c) + rng.normal(0, noise)), noise, 0.6, 0.2)
        for r, c in zip(row, col, strict=True)
    ]
    return shifts, row, col


def test_one_shift_of_many_regions(rng):
    shifts, row, col = regions(rng, 40, lambda r, c: 2.5, lambda r, c: -1.25)
    shifts[3:9] = [Shift(7.0, 7.0, 0.1, 0.4, 0.1)] * 6  # gross errors
    shifts[20:25] = [Shift(0.0, 0.0, np.inf, 0.0, 0.0, "nothing there")] * 5
    field = fit_field(shifts, row, col)
    assert field.accepted, field.refused
    assert field.mean == (pytest.approx(2.5, abs=0.06), pytest.approx(-1.25, abs=0.06))
    assert (field.used, field.regions) == (29, 40)
    assert field.sigma == pytest.approx(field.scatter, rel=0.1) and 0.05 < field.scatter < 0.2
    dx, dy = field.at(0.0, 900.0)
    assert (dx, dy) == (pytest.approx(2.5, abs=0.06), pytest.approx(-1.25, abs=0.06))


def test_an_affine_field_comes_back(rng):
    shifts, row, col = regions(rng, 60, lambda r, c: 1 + 0.003 * c - 0.001 * r, lambda r, c: -2 + 0.002 * r, 0.05)
    field = fit_field(shifts, row, col, "affine")
    assert field.accepted, field.refused
    dx, dy = field.at(np.array([100.0, 900.0]), np.array([800.0, 50.0]))
    np.testing.assert_allclose(dx, [1 + 2.4 - 0.1, 1 + 0.15 - 0.9], atol=0.08)
    np.testing.assert_allclose(dy, [-1.8, -0.2], atol=0.08)


def test_contradicting_or_missing_regions_are_refused(rng):
    row, col = rng.uniform(0, 1000, (2, 30))
    wild = [Shift(float(a), float(b), 0.1, 0.5, 0.1) for a, b in rng.uniform(-6, 6, (30, 2))]
    assert not fit_field(wild, row, col).accepted
    none = [Shift(0.0, 0.0, np.inf, 0.0, 0.0, "image and rendering correlate at 0.02 only")] * 30
    refused = fit_field(none, row, col)
    assert "0 of 30 regions" in refused.refused and "correlate" in refused.refused
    assert np.array_equal(refused.at(row, col)[0], np.zeros(30))  # and nothing is moved
    same, *_ = regions(rng, 30, lambda r, c: 1.0, lambda r, c: 1.0)
    assert (
        fit_field(same, np.full(30, 5.0), col, "affine").basis.form == "constant"
    )  # on one line nothing more is known
    with pytest.raises(GeometryError, match="'constant', 'affine' or 'field'"):
        fit_field(same, row, col, "spline")
