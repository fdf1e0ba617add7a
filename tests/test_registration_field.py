"""Local registration: known smooth fields and relief displacement come back; ground that says nothing is left out."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS
from scipy.ndimage import gaussian_filter, map_coordinates

from stages.physics.images.displacement import Basis, Field, relief_displacement
from stages.physics.images.fit_displacement import fit_field
from stages.physics.images.registration import BLOCK_PX, Shift, block_shift, prepare
from stages.physics.maps.grid import Grid, unit_vectors

SIZE = 256
RADIUS = 1737400.0


def texture(rng, size=SIZE, sigma=1.5):
    """Relief shading of fractal ground, seen by a sensor: as smooth as real images are."""
    f = np.fft.fftfreq(size)
    k = np.hypot(f[:, None], f[None])
    k[0, 0] = 1
    z = np.fft.ifft2(np.fft.fft2(rng.standard_normal((size, size))) * k**-1.7).real
    shade = gaussian_filter(np.gradient(z, axis=1), sigma)
    return 1 + 0.2 * shade / shade.std()


def shown(rendering, dx, dy):
    """The image with image[row + dy, col + dx] = rendering[row, col], by the fixed point of the inverse map."""
    row, col = np.meshgrid(*map(np.arange, rendering.shape), indexing="ij")
    r, c = row.astype(float), col.astype(float)
    for _ in range(20):
        r, c = row - dy(r, c), col - dx(r, c)
    return map_coordinates(rendering, [r, c], order=5, mode="reflect")


class Lattice:
    """Shifts (R, C, 2), errors (R, C, 2) and quality (R, C) of blocks from the upper left corner on; NaN where refused."""

    def __init__(self, image, rendering, valid=None):
        pictures = prepare(image, rendering, valid, None, ())
        corners = range(0, SIZE, BLOCK_PX)
        found = [[block_shift(pictures, (r, c, BLOCK_PX, BLOCK_PX), 8.0) for c in corners] for r in corners]
        refused = np.array([[not s.accepted for s in line] for line in found])
        self.shifts = np.array([[(s.dx, s.dy) for s in line] for line in found])
        self.errors = np.array([[np.sqrt(np.diag(s.place_covariance)) for s in line] for line in found])
        self.shifts[refused] = self.errors[refused] = np.nan
        self.quality = np.array([[s.quality for s in line] for line in found])


@pytest.mark.parametrize("planted", [(3.0, -2.5), (-7.0, 6.6), (0.3, 0.0)])
def test_blocks_capture_shifts_of_many_pixels(rng, planted):
    rendering = texture(rng)
    image = 30 + 90 * shown(rendering, lambda r, c: planted[0], lambda r, c: planted[1])
    found = Lattice(image + rng.normal(0, 1, image.shape), rendering)
    inner = found.shifts[1:3, 1:3]  # the image's edge has no other side
    assert found.shifts.shape == (4, 4, 2) and (found.quality[1:3, 1:3] > 0.5).all()
    np.testing.assert_allclose(inner, np.broadcast_to(planted, inner.shape), atol=0.1)
    assert (found.errors[1:3, 1:3] < 0.1).all()


def test_blocks_without_texture_in_shadow_or_of_other_ground_are_left_out(rng):
    rendering = texture(rng)
    image = shown(rendering, lambda r, c: 2.0, lambda r, c: -1.0)
    image[:64, :64] = texture(rng)[:64, :64]  # other ground
    image[64:128, :64] = 1 + 0.001 * rng.standard_normal((64, 64))  # nothing but noise
    valid = np.ones(image.shape, bool)
    valid[128:192, :64] = False
    found = Lattice(image, rendering, valid)
    assert (found.quality[:3, 0] == 0).all() and np.isnan(found.shifts[:3, 0]).all()
    assert (found.quality[1:, 1:] > 0.5).all()


def test_errors_are_of_the_size_that_they_claim_in_correlated_noise(rng):
    """Noise over 3 px, which a white-noise error would underestimate by far: the errors over their sigma are about 1."""
    ratio = []
    for _ in range(4):
        rendering = texture(rng)
        noise = gaussian_filter(rng.standard_normal(rendering.shape), 1.5)
        image = shown(rendering, lambda r, c: 0.7, lambda r, c: -0.4) + 0.1 * noise / noise.std()
        found = Lattice(image, rendering)
        off = (found.shifts - (0.7, -0.4))[1:3, 1:3] / found.errors[1:3, 1:3]
        ratio += off.ravel().tolist()
    assert len(ratio) == 32 and 0.6 < np.sqrt(np.mean(np.square(ratio))) < 1.6


def blocks(rng, dx, dy, relief=None, share=0.0, noise=0.08, side=9):
    """A lattice of blocks with a known displacement. relief : (n, 2) px per unit share"""
    row, col = (v.ravel() * 64.0 for v in np.mgrid[:side, :side])
    relief = np.zeros((row.size, 2)) if relief is None else relief
    x, y = dx(row, col) + share * relief[:, 0], dy(row, col) + share * relief[:, 1]
    x, y = x + rng.normal(0, noise, x.shape), y + rng.normal(0, noise, y.shape)
    shifts = [
        Shift(a, b, noise, 0.6, 0.2, relief=tuple(u)) for a, b, u in zip(x.tolist(), y.tolist(), relief, strict=True)
    ]
    return shifts, row, col


def wave(r, c):
    return 1.5 * np.sin(r / 160) * np.cos(c / 210)


def test_a_smooth_field_comes_back_through_bad_blocks(rng):
    shifts, row, col = blocks(rng, wave, lambda r, c: -0.8 * wave(c, r))
    for k in rng.choice(len(shifts), 16, replace=False):
        shifts[k] = Shift(*rng.uniform(-7, 7, 2).tolist(), 0.1, 0.5, 0.2)
    field = fit_field(shifts, row, col, "field")
    assert field.accepted and field.form == "field" and field.freedom > 6 and field.held_out > 0.5
    r, c = (v.ravel() for v in np.mgrid[32:480:16, 32:480:16].astype(float))
    dx, dy = field.at(r, c)
    assert np.sqrt(np.mean((dx - wave(r, c)) ** 2)) < 0.1 and np.sqrt(np.mean((dy + 0.8 * wave(c, r)) ** 2)) < 0.1
    assert 60 <= field.used <= 68


def test_the_share_of_relief_displacement_comes_back(rng):
    """Beside a smooth field, within its error, which is small; and none is found where there is none."""
    relief = gaussian_filter(rng.standard_normal((9, 9)), 0.7).reshape(-1, 1) * np.array([[2.0, 1.0]])
    relief *= 1.5 / np.abs(relief).mean()
    for share in (1.0, 0.0):
        shifts, row, col = blocks(rng, wave, wave, relief, share)
        field = fit_field(shifts, row, col, "field", reference=0.0)
        if share:
            assert field.form == "field + relief" and field.share_error < 0.05
            assert abs(field.share - share) < 3 * field.share_error
        assert field.share == pytest.approx(share, abs=0.06)


@pytest.mark.parametrize(
    ("planted", "expected"),
    [(lambda r, c: 0.5 + 0 * r, "constant"), (lambda r, c: 0.5 + 0.004 * r, "affine"), (wave, "field")],
)
def test_held_out_blocks_choose_the_plainest_form_that_does(rng, planted, expected):
    shifts, row, col = blocks(rng, planted, planted)
    field = fit_field(shifts, row, col, "field")
    assert field.basis.form == expected
    dx, _ = field.at(row, col)
    assert np.sqrt(np.mean((dx - planted(row, col)) ** 2)) < 0.06


def test_images_that_lie_right_stay_where_they_are(rng):
    """No displacement, blocks that scatter as over simulated ground: what is taken off is below 0.05 px rms."""
    for _ in range(5):
        relief = rng.normal(0, 1.0, (81, 2))
        shifts, row, col = blocks(rng, lambda r, c: 0 * r, lambda r, c: 0 * r, relief, noise=0.15)
        field = fit_field(shifts, row, col, "field", reference=0.0)
        dx, dy = field.at(row, col, tuple(relief.T))
        assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.05


def test_a_field_interpolates_its_knots_and_stays_level_outside():
    basis = Basis("field", (10.0, 20.0), 50.0, (3, 4))
    linear = np.add.outer(2.0 * np.arange(-1, 5), 3.0 * np.arange(-1, 6)).ravel()  # of 3 + 3 and 4 + 3 knots
    row, col = np.array([10.0, 85.0, 160.0]), np.array([20.0, 120.0, 220.0])
    expected = 2 * (row - 10) / 50 + 3 * (col - 20) / 50
    np.testing.assert_allclose(basis.matrix(row, col) @ linear, expected, atol=1e-12)
    np.testing.assert_allclose(basis.mixture(linear, row, col), expected, atol=1e-12)
    np.testing.assert_allclose(basis.bending() @ linear, 0, atol=1e-12)
    outside = basis.mixture(linear, np.array([-500.0]), np.array([20.0]))
    assert outside == pytest.approx(expected[0])


def test_relief_displacement_is_height_times_tangent_of_emission_away_from_the_camera():
    crs = CRS.from_proj4(f"+proj=eqc +R={RADIUS} +units=m +no_defs")
    grid = Grid(crs.to_wkt(), Affine(100, 0, -50000, 0, -100, 50000), 1000, 1000, RADIUS)
    camera = unit_vectors(0.0, 0.0) * (RADIUS + 100000.0)  # above the middle, (499.5, 499.5)
    relief = relief_displacement(grid, camera, 500.0)
    dx, dy = relief(np.array([499.5, 499.5, 199.5]), np.array([499.5, 799.5, 499.5]), np.array([900.0, 900.0, 100.0]))
    # 30 km from below the camera, 98.6 and 99.4 km above the ground: h tan(emission), with the ground's own curvature
    angle = 30000 / RADIUS
    tangents = [
        np.tan(angle + np.arctan2((RADIUS + h) * np.sin(angle), RADIUS + 100000 - (RADIUS + h) * np.cos(angle)))
        for h in (900, 100)
    ]
    np.testing.assert_allclose(dx, [0, 400 * tangents[0] / 100, 0], atol=0.02)
    np.testing.assert_allclose(dy, [0, 0, 400 * tangents[1] / 100], atol=0.02)  # lower ground: towards the camera


def test_relief_within_a_block_is_told_apart_from_its_shift(rng):
    """The share is also found from what relief does inside one block, and a field without data is refused."""
    rendering = texture(rng)
    height = gaussian_filter(rng.standard_normal(rendering.shape), 8)
    height = 0.5 * height / height.std()
    image = shown(
        rendering, lambda r, c: 0.4 + map_coordinates(height, [r, c], order=1, mode="nearest"), lambda r, c: 0 * r
    )
    pictures = prepare(image, rendering, relief=np.stack([height, 0 * height]))
    found = block_shift(pictures, (96, 96, 64, 64), 4.0)
    assert found.share == pytest.approx(1.0, abs=0.15)
    assert found.dx == pytest.approx(0.4 + found.relief[0], abs=0.1)


def test_a_refused_field_moves_nothing():
    field = Field(Basis("constant", (0.0, 0.0)), np.ones((2, 1)), 0, 9, 1.0, 1.0, 0.0, refused="too little")
    assert [v.tolist() for v in field.at([1.0], [2.0])] == [[0.0], [0.0]]
