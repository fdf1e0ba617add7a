"""What is left in words: faults of a detector are told from ground, noise and good cameras."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, shift
from scipy.stats import chi2, norm

from stages.diagnose.faults import Innovation, innovations, on_partitions, pixels, specks, steps_of_brightness, waves
from stages.diagnose.likelihood.columns import Plan
from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.intervals import together
from stages.diagnose.likelihood.patches import make_grid
from stages.diagnose.likelihood.products import Products, Rows
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.settings import LINE

SIZE, FRAMES = 48, 6


def left(seed, fault=None, grounds=8, red=0.0) -> list[Innovation]:
    """White residuals of six images on some grounds, each of which lies elsewhere on the detector; red : px, sigma of a blur of the noise

    fault : (images (n, h, w), lines, samples, number of the ground, generator) -> images
    """
    rng = np.random.default_rng(seed)
    out = []
    for ground in range(grounds):
        y, x = np.mgrid[:SIZE, :SIZE].astype(float)
        line, sample = y + rng.uniform(0, 40), x + rng.uniform(0, 40)
        images = rng.normal(size=(FRAMES, SIZE, SIZE))
        if red:
            images = gaussian_filter(images, (0, red, red))
            images /= images.std()
        if fault is not None:
            images = fault(images, line, sample, ground, rng)
        detector = torch.tensor(np.broadcast_to(np.stack([line, sample]), (FRAMES, 2, SIZE, SIZE)).copy())
        seen = torch.ones(FRAMES, SIZE, SIZE, dtype=torch.bool)
        out.append(Innovation(torch.tensor(images), seen, detector, torch.arange(FRAMES), ground))
    return out


def found(*args, **options) -> dict[str, float]:
    """Words of the partitions that differ, and their shares."""
    return on_partitions(pixels(left(*args, **options)))


def rows(seed: int, grounds: int = 8) -> list[Rows]:
    """White residuals as coefficients."""
    rng = np.random.default_rng(seed)
    grid = make_grid(SIZE, SIZE)
    out = []
    for ground in range(grounds):
        images = torch.tensor(rng.normal(0, 1, (FRAMES, SIZE, SIZE)))
        z = torch.fft.rfft2(images).flatten(-2)[:, grid.keep] * grid.root
        patch = SimpleNamespace(
            number=ground, site=ground, frames=torch.arange(FRAMES), slopes=torch.zeros(FRAMES, 2),
            weight=torch.ones(FRAMES, SIZE, SIZE), dark_frames=torch.zeros(0, dtype=torch.long),
        )  # fmt: skip
        none = torch.zeros(1, FRAMES)
        out.append(Rows(patch, z.to(torch.complex64)[None], none, z[:0], none[:0], torch.zeros(1, 0)))
    return out


@pytest.mark.parametrize("red", [0.0, 1.5])
def test_noise_differs_between_the_cells_of_no_partition(red):
    """Neither white noise nor noise of some pixels' width: the level is 1 % for all partitions together."""
    assert sum(bool(found(seed, red=red)) for seed in range(12)) <= 1


COLUMNS, LINES = np.random.default_rng(6).normal(0, 0.4, 200), np.random.default_rng(7).normal(0, 0.5, (8, 6, 200))
DUST = gaussian_filter(np.random.default_rng(9).normal(size=(120, 120)), 1.5)
DUST *= 0.5 / DUST.std()
BLOCKS = np.random.default_rng(4).normal(0, 3, (20, 20))
FAULTS = {
    "odd and even columns": lambda i, line, sample, ground, rng: i + 0.2 * np.cos(np.pi * np.round(sample)),
    "a seam between columns": lambda i, line, sample, ground, rng: (
        i + 0.5 * rng.normal(size=(FRAMES, 1, 1)) * (sample > 44)
    ),
    "bands over the lines": lambda i, line, sample, ground, rng: (
        i + 0.4 * np.sin(2 * np.pi * (line / 7.3 + rng.uniform(size=(FRAMES, 1, 1))))
    ),
    "single columns": lambda i, line, sample, ground, rng: i + 1.0 * (np.round(sample) == 44),
    "lines of the detector that are brighter": lambda i, line, sample, ground, rng: (
        i + LINES[ground][:, np.round(line).astype(int)]
    ),
    "a pattern that stays on the detector": lambda i, line, sample, ground, rng: (
        i + DUST[np.round(line).astype(int), np.round(sample).astype(int)]
    ),
    "edges every eight pixels": lambda i, line, sample, ground, rng: (
        i + BLOCKS[(line // 8).astype(int), (sample // 8).astype(int)]
    ),
}


@pytest.mark.parametrize("words", FAULTS)
def test_a_fault_has_its_words(words):
    every = found(1, FAULTS[words])
    assert any(what.startswith(words) for what in every), every


def test_a_broad_field_of_each_image_is_the_same_on_all_ground():
    slopes = np.random.default_rng(3).normal(0, 0.03, (2, FRAMES, 1, 1))
    every = found(1, lambda i, line, sample, ground, rng: i + slopes[0] * (line - 40) + slopes[1] * (sample - 40))
    assert any(what.startswith("a broad field") for what in every), every


def test_blocks_of_seven_pixels_are_no_compression():
    def sevens(i, line, sample, ground, rng):
        return i + BLOCKS[(line // 7).astype(int), (sample // 7).astype(int)]

    assert not any(what.startswith("edges every eight") for what in found(1, sevens))


def test_an_innovation_is_what_the_other_images_do_not_foretell():
    """Albedo that all six share is foretold; noise that one has alone stays, in units of what is not foretold."""
    grid = make_grid(SIZE, SIZE)
    model = Covariance.white(grid.annuli, FRAMES)
    model.albedo[:] = 1e4
    given, plain = rows(3), rows(3)[0].shared[0].clone()
    shared = torch.randn(len(grid.keep), dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    for row in given:
        row.shared[0] += 30 * shared * grid.root
        row.patch.images, row.patch.rows, row.patch.columns = torch.arange(FRAMES), slice(SIZE), slice(SIZE)
    sites = [SimpleNamespace(on_detector=lambda: torch.zeros(FRAMES, 2, SIZE, SIZE))] * len(given)
    plane = torch.zeros(FRAMES, SIZE * (SIZE // 2 + 1), dtype=plain.dtype)
    plane[:, grid.keep] = plain / grid.root
    noise = torch.fft.irfft2(plane.unflatten(1, (SIZE, -1)), s=(SIZE, SIZE))
    value = innovations(given, model, grid, sites)[0].value
    expected = noise - noise.mean(0)  # the rest of six values about their mean
    assert torch.allclose(value, expected / expected.square().mean((-2, -1), keepdim=True).sqrt(), atol=2e-2)


def test_a_wave_of_a_frame_stands_out_of_its_spectrum():
    grid = make_grid(SIZE, SIZE)
    white = Covariance.white(grid.annuli, FRAMES)
    assert waves(rows(1), white, grid, FRAMES)[0] < LINE
    every = rows(1)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    wave = torch.tensor(0.5 * np.sin(2 * np.pi * (9 * x + 5 * y)))
    for row in every:
        row.shared[0][2] += (torch.fft.rfft2(wave).flatten()[grid.keep] * grid.root).to(torch.complex64)
    chance, share, rms = waves(every, white, grid, FRAMES)
    assert chance > LINE and share > 0.05 and rms == pytest.approx(0.5 / 2**0.5, rel=0.1)


def test_a_pixel_stands_out_by_more_than_small_shadows_and_rough_ground_do():
    assert all(specks(left(seed)) == (0, 0.0) for seed in range(20))
    for sign, ordinary in ((1, 15.0), (-1, 25.0)):
        every = left(1)
        every[3].value[2, 15, 16] = ordinary * sign  # as a facet or, darker, a small shadow
        assert specks(every) == (0, 0.0)
        every[3].value[2, 15, 16] = 45.0 * sign
        assert specks(every) == (1, pytest.approx(45**2 / (8 * FRAMES * SIZE**2), rel=0.05))
        every[3].value[2, 10:21, 11:22] *= 5.0  # rough ground about it
        every[3].value[2, 15, 16] = 45.0 * sign
        assert specks(every) == (0, 0.0)


def test_steps_of_brightness_survive_resampling_and_smooth_brightness_has_none():
    rng = np.random.default_rng(8)
    rough = gaussian_filter(rng.normal(size=(FRAMES, 128, 128)), (0, 6, 6))
    noisy = 0.05 * (1 + 0.05 * rough / rough.std() + 0.004 * rng.normal(size=rough.shape))

    def steps(step: float, resampled: bool = True) -> tuple[float, float, int]:
        read = np.round(noisy / step) * step if step else noisy
        read = shift(read, (0, 0.3, 0.4), order=3, mode="nearest") if resampled else read
        read = torch.from_numpy(read)
        return steps_of_brightness(
            [SimpleNamespace(read=read, read_valid=torch.ones_like(read).bool(), frames=np.arange(FRAMES))], FRAMES
        )

    assert steps(0.0)[0] < 5
    codes = 0.01 * np.sqrt(0.05)  # of a camera that compands its numbers
    read = shift((np.round(np.sqrt(noisy) / codes) * codes) ** 2, (0, 0.3, 0.4), order=1, mode="nearest")
    read = torch.from_numpy(read)
    chance, rms, _ = steps_of_brightness(
        [SimpleNamespace(read=read, read_valid=torch.ones_like(read).bool(), frames=np.arange(FRAMES))], FRAMES
    )
    assert chance > LINE and rms == pytest.approx(2 * 0.01 / 12**0.5, rel=0.3)
    for resampled in (False, True):
        chance, rms, _ = steps(0.001, resampled)
        assert chance > LINE and rms == pytest.approx(0.001 / 0.05 / 12**0.5, rel=0.3)


def test_many_values_are_as_far_from_nothing_as_chi_square_has_it():
    for sure in (2.6, 4.0):
        assert together(sure, 1) == pytest.approx(sure)
        for count in (2, 3, 8):
            assert chi2.sf(together(sure, count) ** 2, count) == pytest.approx(2 * norm.sf(sure))


@pytest.mark.parametrize("seed", range(4))
def test_albedo_that_grows_over_a_crop_is_of_that_ground(seed):
    """A candidate that looks half like it is off by no more than its error, which says how much of it is lost."""
    rng = np.random.default_rng(seed)
    shared = ["coefficient 0", "brighter to the east", "brighter to the south", "candidate"]
    plan = Plan(shared=shared, prior={0: np.inf}, ground=[1, 2])
    units = []
    for ground in range(12):
        columns = rng.normal(0, 1, (4, 400))
        columns[3] += columns[1]
        residual = rng.normal(0, 1, 400) + rng.normal(0, 5, 2) @ columns[1:3] + 0.1 * columns[3] + 3.0 * columns[0]
        every = np.vstack([residual, columns])
        units.append(Products(every @ every.T, np.arange(5), np.zeros((5, 0)), np.zeros(0), ground))
    whole = Whole(units, plan, 1)
    amounts, errors, covariance = whole.errors(np.array([4]))
    assert abs(amounts[0] - 0.1) < 3.5 * errors[0]
    assert errors[0] < 0.04
    assert covariance[0, 0] ** 0.5 == pytest.approx((12 * 400) ** -0.5, rel=0.1)
