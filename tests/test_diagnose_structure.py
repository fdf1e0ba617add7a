"""What `diagnose` takes for structure, and for ground: fields that an image has alike everywhere, albedo that grows over a crop."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, shift
from scipy.stats import chi2, norm

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.products import Products, Rows
from stages.diagnose.likelihood.tails import together
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.rows.columns import Plan
from stages.diagnose.rows.patches import make_grid
from stages.diagnose.settings import LINE, NOTABLE, PEAK, SURE
from stages.diagnose.structure import kinds
from stages.diagnose.structure.amplifiers import odd_and_even
from stages.diagnose.structure.blocks import blocks_of_compression
from stages.diagnose.structure.detector import pattern_of_detector
from stages.diagnose.structure.fields import field_of_images
from stages.diagnose.structure.innovations import Innovation, innovations
from stages.diagnose.structure.lines import across_columns, line_of_brightness, line_of_displacement
from stages.diagnose.structure.pixels import pixels_that_stand_out
from stages.diagnose.structure.steps import steps_of_brightness

SIZE, FRAMES = 32, 6


def rows(field: float, seed: int, apart: float = 0.0, grounds: int = 8, albedo: float = 0.0) -> list[Rows]:
    """White residuals of six images on some grounds, and a broad field of its own in each image; apart : px between grounds on the detector.

    albedo : of a slope of brightness that all images of a ground share
    """
    rng = np.random.default_rng(seed)
    grid = make_grid(SIZE, SIZE)
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE - 0.5
    fields = [field * (a * x + b * y) for a, b in rng.normal(0, 1, (FRAMES, 2))]
    out = []
    for ground in range(grounds):
        a, b = albedo * rng.normal(0, 1, 2)
        images = torch.tensor(np.stack([f + a * x + b * y + rng.normal(0, 1, f.shape) for f in fields]))
        z = torch.fft.rfft2(images).flatten(-2)[:, grid.keep] * grid.root
        patch = SimpleNamespace(
            number=ground, site=ground, frames=torch.arange(FRAMES), slopes=torch.zeros(FRAMES, 2),
            weight=torch.ones(FRAMES, SIZE, SIZE), middle=torch.full((FRAMES, 2), apart * ground),
            dark_frames=torch.zeros(0, dtype=torch.long),
        )  # fmt: skip
        none = torch.zeros(1, FRAMES)
        out.append(Rows(patch, z.to(torch.complex64)[None], none, z[:0], none[:0], torch.zeros(1, 0)))
    return out


def test_a_field_of_its_own_is_seen_where_ground_falls_on_the_same_part_of_the_detector():
    grid = make_grid(SIZE, SIZE)
    model = Covariance.white(grid.annuli, FRAMES)
    found = [field_of_images(rows(0.0, seed), model, grid) for seed in range(40)]
    assert np.mean([share for share, _ in found]) == pytest.approx(0.0, abs=0.01)
    assert sum(low > 0 for _, low in found) <= 4  # of 40 at 2.5 %
    share, low = field_of_images(rows(1.5, 1), model, grid)
    assert 0 < low < share
    assert field_of_images(rows(1.5, 1, apart=SIZE), model, grid) == (0.0, 0.0)


def test_ground_that_is_alike_by_chance_is_no_field_of_the_images():
    """All images see the albedo of few grounds, which may be alike: what one ground shares with the others they share with it."""
    grid = make_grid(SIZE, SIZE)
    model = Covariance.white(grid.annuli, FRAMES)
    found = [field_of_images(rows(0.0, seed, grounds=4, albedo=2.0), model, grid) for seed in range(60)]
    assert sum(low > 0 for _, low in found) <= 5 and max(share for share, _ in found) > 0.2
    found = [field_of_images(rows(2.0, seed, grounds=4), model, grid) for seed in range(10)]
    assert sum(low > 0 for _, low in found) >= 8


def left(seed: int, fault=lambda images, slopes, line, sample: images, grounds: int = 8) -> list[Innovation]:
    """White innovations of six images of some grounds with a fault, each image on another part of the detector, ground not in line with it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    out = []
    for ground in range(grounds):
        at = rng.uniform(0, 2 * SIZE, (FRAMES, 2))[:, :, None, None]
        detector = 0.87 * np.stack([y + 0.1 * x, x - 0.1 * y]) + at
        rough = gaussian_filter(rng.normal(size=(SIZE, SIZE)), 1.5)
        bright = 1 + 0.1 * rough / rough.std()
        slopes = np.gradient(bright)
        images = fault(rng.normal(0, 1, (FRAMES, SIZE, SIZE)), slopes, *detector.swapaxes(0, 1))
        weight = torch.ones(FRAMES, SIZE, SIZE)
        patch = SimpleNamespace(
            site=ground, weight=weight, scale=torch.tensor(bright).expand(FRAMES, -1, -1), frames=torch.arange(FRAMES)
        )
        out.append(Innovation(patch, torch.tensor(images), weight > 0, torch.tensor(detector)))
    return out


def test_an_innovation_is_what_the_other_images_do_not_foretell():
    """Albedo that all six share is foretold; noise that one has alone stays, in units of what is not foretold."""
    grid = make_grid(SIZE, SIZE)
    model = Covariance.white(grid.annuli, FRAMES)
    model.albedo[:] = 1e4
    given = rows(0.0, 3)
    shared = torch.randn(len(grid.keep), dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    for row in given:
        row.shared[0] += 30 * shared * grid.root
    sites = [SimpleNamespace(on_detector=lambda: torch.zeros(FRAMES, 2, SIZE, SIZE))] * len(given)
    for row in given:
        row.patch.images, row.patch.rows, row.patch.columns = torch.arange(FRAMES), slice(SIZE), slice(SIZE)
    noise = torch.fft.irfft2(_plane(rows(0.0, 3)[0].shared[0] / grid.root, grid), s=(SIZE, SIZE))
    found = innovations(given, model, grid, sites)[0].value
    expected = noise - noise.mean(0)  # the rest of six values about their mean
    assert torch.allclose(found, expected / expected.square().mean((-2, -1), keepdim=True).sqrt(), atol=2e-2)


def _plane(z: torch.Tensor, grid) -> torch.Tensor:
    plane = torch.zeros(len(z), SIZE * (SIZE // 2 + 1), dtype=z.dtype)
    plane[:, grid.keep] = z
    return plane.unflatten(1, (SIZE, -1))


def test_a_pixel_stands_out_by_more_than_small_shadows_and_rough_ground_do():
    assert all(pixels_that_stand_out(left(seed)) == (0, 0.0) for seed in range(20))
    for sign, ordinary in ((1, 15.0), (-1, 25.0)):
        every = left(1)
        every[3].value[2, 15, 16] = ordinary * sign  # as a facet or, darker, a small shadow
        assert pixels_that_stand_out(every) == (0, 0.0)
        every[3].value[2, 15, 16] = 45.0 * sign
        assert pixels_that_stand_out(every) == (1, pytest.approx(45**2 / (8 * FRAMES * SIZE**2), rel=0.05))
        every[3].value[2, 10:21, 11:22] *= 5.0  # rough ground about it
        every[3].value[2, 15, 16] = 45.0 * sign
        assert pixels_that_stand_out(every) == (0, 0.0)


def test_what_stays_on_the_detector_is_told_from_what_goes_with_the_ground():
    pattern = np.random.default_rng(9).normal(0, 0.5, (4 * SIZE, 4 * SIZE))

    def dusty(images, slopes, line, sample):
        return images + pattern[np.round(line).astype(int), np.round(sample).astype(int)]

    assert not any(pattern_of_detector(left(seed), 0.0) for seed in range(10))
    # a fifth of the squares; once smoothed, less where images lie a fraction of a pixel beside each other
    assert 0.13 < pattern_of_detector(left(1, dusty), NOTABLE) < 0.2
    albedo = np.random.default_rng(5)
    assert pattern_of_detector(left(1, lambda images, *_: images + albedo.normal(0, 2, (SIZE, SIZE))), 0.0) == 0


def test_dust_is_broader_than_a_pixel_and_no_matter_of_columns_and_lines():
    """Rings that darken by a third of the noise are 1 to 2 % of the squares of pixels, and several times that of what is broader."""
    where = np.hypot(*np.mgrid[-12:13, -12:13])
    ring = np.exp(-0.5 * ((where - 6) / 1.5) ** 2)
    detector = np.zeros((5 * SIZE, 5 * SIZE))
    draw = np.random.default_rng(4)
    for y, x in draw.integers(12, 5 * SIZE - 13, (30, 2)):
        detector[y - 12 : y + 13, x - 12 : x + 13] -= 0.35 * ring

    def dusty(images, slopes, line, sample):
        return images + detector[np.round(line).astype(int), np.round(sample).astype(int)]

    def striped(images, slopes, line, sample):
        return images + 0.4 * np.sin(line / 3) + 0.4 * np.cos(sample / 4)

    assert 0.02 < pattern_of_detector(left(1, dusty, grounds=24), NOTABLE) < 0.06
    assert pattern_of_detector(left(1, striped, grounds=24), NOTABLE) == 0


def test_the_nearest_pixel_of_a_detector_leaves_lines_in_where_it_shows_the_ground_and_not_in_brightness():
    def nearest(images, slopes, line, sample):
        down, across = (x / x.std() for x in slopes)
        return images + 2 * ((line - np.round(line)) * down + (sample - np.round(sample)) * across)

    grid = make_grid(SIZE, SIZE)
    assert max(line_of_displacement(left(seed), grid, FRAMES)[0] for seed in range(20)) < 5
    chance, share = line_of_displacement(left(1, nearest), grid, FRAMES)
    assert chance > 25 and share > 0.005
    assert line_of_brightness(rows(0.0, 1), Covariance.white(grid.annuli, FRAMES), grid, FRAMES)[0] < 5


def test_odd_and_even_columns_differ_by_no_more_than_chance_unless_they_do():
    def alternate(images, slopes, line, sample, size=0.15):
        return images + size * np.cos(np.pi * sample)

    flat = np.random.default_rng(6).normal(0, 0.3, 4 * SIZE)

    def own_columns(images, slopes, line, sample):
        return images + flat[np.round(sample).astype(int)]

    chance = [odd_and_even(left(seed))[0] for seed in range(40)]
    assert max(chance) < SURE and np.median(chance) < 2
    assert max(odd_and_even(left(seed, own_columns))[0] for seed in range(20)) < SURE
    for axis in (1, -1):  # columns, lines
        surely, share = odd_and_even(
            left(1, lambda images, slopes, *at, axis=axis: alternate(images, slopes, *at[::axis]))
        )
        assert surely > 2 * SURE and share == pytest.approx(0.15**2 / 2, rel=0.3)


@pytest.mark.parametrize("turned", [0.0, 0.3, 1.2])
def test_waves_across_the_columns_of_a_turned_detector(turned):
    grid = make_grid(SIZE, SIZE)
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    c, s = np.cos(turned), np.sin(turned)
    detector = torch.tensor(0.9 * np.stack([c * y - s * x, s * y + c * x]))[None]
    known = SimpleNamespace(detector_line=detector[:, 0])
    site = SimpleNamespace(observation=known, on_detector=lambda: detector, frames=np.array([1]))
    across = across_columns([site], grid, 2)
    assert bool(across[0].all())  # nobody knows how its detector lies
    assert 0.01 < across[1].double().mean() < 0.15
    columns = np.random.default_rng(2).normal(size=200)
    flat = columns[
        np.round(detector[0, 1].numpy()).astype(int) + 60
    ]  # the nearest column: waves that are too short for the map as well
    window = np.hanning(SIZE)[:, None] * np.hanning(SIZE)
    power = torch.fft.rfft2(torch.tensor(flat * window)).flatten()[grid.keep].abs().square()
    assert float(power[across[1]].sum() / power.sum()) > 0.5  # the window has a third on the waves beside them


def test_blocks_of_compression_are_told_from_anything_else():
    """Each block of eight pixels of the detector has a level of its own, as strongly compressed images have; blocks of seven have no reason."""
    levels = np.random.default_rng(4).normal(0, 3, (16, 16))

    def compressed(images, slopes, line, sample, side=8):
        return images + levels[(line // side).astype(int), (sample // side).astype(int)]

    assert max(blocks_of_compression(left(seed), FRAMES)[0] for seed in range(20)) < PEAK
    ratio, share = blocks_of_compression(left(1, compressed), FRAMES)
    assert ratio > PEAK and share > NOTABLE
    assert blocks_of_compression(left(1, partial(compressed, side=7)), FRAMES)[0] < 1


def test_what_lies_between_pixels_every_eighth_of_which_is_alike_is_no_compression():
    """Bilinear resampling smooths most half-way between pixels; where a pixel of the map is 8/7 of the detector's, that comes back every eight."""
    every = left(2)
    for ground, one in enumerate(every):  # crops of one map
        sample = (8 / 7 * (torch.arange(SIZE, dtype=torch.float64) + 11 * ground) + 0.3).expand(FRAMES, SIZE, SIZE)
        one.value = one.value * torch.hypot(sample % 1, 1 - sample % 1)
        one.detector = torch.stack([one.detector[:, 0], sample], 1)
    assert blocks_of_compression(every, FRAMES)[0] < PEAK


def test_steps_of_brightness_survive_resampling_and_smooth_brightness_has_none():
    rng = np.random.default_rng(8)
    rough = gaussian_filter(rng.normal(size=(FRAMES, 128, 128)), (0, 6, 6))
    noisy = 0.05 * (1 + 0.05 * rough / rough.std() + 0.004 * rng.normal(size=rough.shape))

    def found(step: float, resampled: bool = True) -> tuple[float, float, int]:
        read = np.round(noisy / step) * step if step else noisy
        read = shift(read, (0, 0.3, 0.4), order=3, mode="nearest") if resampled else read
        read = torch.from_numpy(read)
        return steps_of_brightness(
            [SimpleNamespace(read=read, read_valid=torch.ones_like(read).bool(), frames=np.arange(FRAMES))], FRAMES
        )

    assert found(0.0)[0] < 5
    codes = 0.01 * np.sqrt(0.05)  # of a camera that compands its numbers
    read = shift((np.round(np.sqrt(noisy) / codes) * codes) ** 2, (0, 0.3, 0.4), order=1, mode="nearest")
    read = torch.from_numpy(read)
    chance, rms, _ = steps_of_brightness(
        [SimpleNamespace(read=read, read_valid=torch.ones_like(read).bool(), frames=np.arange(FRAMES))], FRAMES
    )
    assert chance > LINE and rms == pytest.approx(2 * 0.01 / 12**0.5, rel=0.3)
    for resampled in (False, True):
        chance, rms, _ = found(0.001, resampled)
        assert chance > LINE and rms == pytest.approx(0.001 / 0.05 / 12**0.5, rel=0.3)


def test_what_counts_as_structure_is_more_than_good_cameras_leave(monkeypatch):
    """Two specks, a line that a flat field leaves, displacements that bilinear resampling leaves: none; beyond that, each has its words."""
    nothing = {
        "line_of_brightness": (0.0, 0.0, 0.0), "line_of_displacement": (0.0, 0.0), "field_of_images": (0.0, 0.0),
        "pattern_of_detector": 0.0, "pixels_that_stand_out": (0, 0.0),
        "steps_of_brightness": (0.0, 0.0, -1), "blocks_of_compression": (0.0, 0.0), "odd_and_even": (0.0, 0.0),
        "lines_of_their_own": (0.0, 0.0),
    }  # fmt: skip
    state = SimpleNamespace(sites=[], frames=1)
    grid = make_grid(SIZE, SIZE)
    view = SimpleNamespace(
        rows=[], model=Covariance(*[None] * 2, 1e-4 * torch.ones(grid.annuli, 1), *[0.0] * 3), grid=grid
    )

    def words(piled=0.0, off_columns=(0.0, 0.0, 0.0), **found):
        for name, value in {**nothing, **found}.items():
            monkeypatch.setattr(kinds, name, lambda *_, value=value: value)
        lines = found.get("line_of_brightness", off_columns)
        monkeypatch.setattr(kinds, "line_of_brightness", lambda *given: lines if given[-1] is None else off_columns)
        return list(kinds.structure(state, view, piled))

    assert words() == []
    assert words(pixels_that_stand_out=(2, 0.1)) == []
    assert words(pixels_that_stand_out=(3, 0.1)) == ["3 single pixels that stand out"]
    assert words(line_of_brightness=(40.0, 0.01, 0.002)) == []
    assert words(line_of_brightness=(40.0, 0.01, 0.003)) == ["lines across an image"]
    assert words(off_columns=(40.0, 0.01, 0.002)) == ["lines across an image"]  # no flat field leaves those
    assert words(off_columns=(15.0, 0.01, 0.002)) == []
    assert words(line_of_displacement=(40.0, 0.005)) == []
    assert len(words(line_of_displacement=(40.0, 0.02))) == 1
    assert words(field_of_images=(0.05, 0.02)) == []  # not surely
    assert len(words(pattern_of_detector=0.05, field_of_images=(0.05, 0.04))) == 2
    assert words(steps_of_brightness=(15.0, 0.002, 0)) == [] == words(steps_of_brightness=(40.0, 0.0009, 0))
    assert words(steps_of_brightness=(40.0, 0.002, 0)) == ["brightness that comes in equal steps"]
    assert words(odd_and_even=(3.0, 0.01)) == [] == words(odd_and_even=(9.0, 0.0001))
    assert len(words(odd_and_even=(9.0, 0.01))) == 1
    assert words(blocks_of_compression=(5.0, 0.05)) == [] == words(blocks_of_compression=(9.0, 0.0003))
    assert len(words(blocks_of_compression=(9.0, 0.005))) == 1
    assert words(lines_of_their_own=(0.01, 0.002)) == []
    assert len(words(lines_of_their_own=(0.01, 0.008))) == 1
    assert words(piled=0.01) == [kinds.PILED]


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
