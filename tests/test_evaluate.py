"""The comparison of models on a scene whose reflectance is known."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from evaluation_scene import A, B, C, KnowsTheTruth, make_scene

from stages.common.intervals import ERROR, LOG, ratio_interval
from stages.evaluate import least_squares
from stages.evaluate.config import Config
from stages.evaluate.fitting import as_pixels, choose_fit_pairs, draw_pixels
from stages.evaluate.metrics import ssim
from stages.evaluate.renderers import Constant, Renderer, read_batch, unit_images
from stages.evaluate.rows import HAPKE_FREE
from stages.evaluate.task import Task, score_here, summarise
from stages.physics.photometry import get_model

REQUIRED = {
    "learned", "global", "kernels", "hapke_fitted", "lunar_lambert", "hapke_raw", "hapke_minmax", "hapke_gain",
    "hapke_gain_offset",
}  # fmt: skip
MATCHED = {f"{n}_gain_offset" for n in ("learned", "global", "kernels", "hapke_fitted", "lunar_lambert", "hapke")}


@pytest.fixture(scope="module")
def scene():
    return make_scene(np.random.default_rng(7))


@pytest.fixture(scope="module")
def whole(scene):
    """The evaluation of all rows: (result, rows, scores, scale)."""
    return _evaluate(scene)


def _evaluate(scene, units="iof", predictor=None, **options):
    wanted = np.flatnonzero(scene.split == 2)
    predictors = predictor if isinstance(predictor, list) else [predictor or KnowsTheTruth()]
    task = Task(replace(scene, units=units), predictors, wanted, Config(batch=7, **options))
    rows, scores, scale = score_here(task)
    return summarise(task, scores, scale), rows, scores, scale


def test_the_true_coefficients_leave_only_the_noise(scene, whole):
    result, _, scores, _ = whole
    models = result["models"]
    assert set(models) == REQUIRED | MATCHED
    assert models["learned"]["mse"] == pytest.approx(scene.noise**2, rel=0.03)
    assert models["learned"]["mse_low"] < scene.noise**2 * 1.01 < models["learned"]["mse_high"] * 1.01
    assert models["learned"]["psnr"] == pytest.approx(-20 * np.log10(scene.noise), abs=0.1)
    per_crop = scene.mask[scene.split == 2].sum(axis=(1, 2))
    assert models["learned"]["mse_crop_sum"] == pytest.approx(models["learned"]["mse"] * per_crop.mean(), rel=1e-9)
    assert (scores.pixels == per_crop).all()
    for name in REQUIRED - {"learned"}:
        assert models[name]["mse"] > 2 * models["learned"]["mse"], name
        assert result["gains"]["learned"][name]["gain_percent_low"] > 50
    json.dumps(result, allow_nan=False)


def test_more_freedom_never_fits_a_crop_worse(scene, whole):
    _, _, scores, _ = whole
    mse = dict(zip(scores.names, scores.mse, strict=True))
    assert (mse["hapke_gain_offset"] <= mse["hapke_gain"] * (1 + 1e-5)).all()
    assert (mse["hapke_gain"] <= mse["hapke_raw"] * (1 + 1e-5)).all()
    assert (mse["hapke_gain_offset"] <= mse["hapke_minmax"] * (1 + 1e-5)).all()
    assert {n for n in mse if n.endswith("gain_offset")} == MATCHED
    for name in MATCHED - {"hapke_gain_offset"}:
        assert (mse[name] <= mse[name.removesuffix("_gain_offset")] * (1 + 1e-5)).all(), name


def test_the_global_set_is_the_least_squares_solution(scene, whole):
    _, rows, _, _ = whole
    train = np.flatnonzero(scene.split == 0)
    east, north = np.gradient(scene.elevation[train].astype(float), 5.0, axis=(2, 1))
    sun = scene.sun[train]
    incidence = (sun[:, 2, None, None] - east * sun[:, 0, None, None] + north * sun[:, 1, None, None]) / np.sqrt(
        1 + east**2 + north**2
    )
    phase = np.broadcast_to(sun[:, 2, None, None], incidence.shape)
    use = scene.mask[train]
    lit = (incidence > 0).astype(float)
    design = np.stack([incidence * lit, phase * lit, lit], axis=-1)[use]
    expected = np.linalg.lstsq(design, scene.images[train][use].astype(float), rcond=None)[0]
    found = next(r for r in rows if r.name == "global").renderer.coefficients(None)[0, :, 0, 0]
    assert found.numpy() == pytest.approx(expected, abs=2e-5)


def test_lunar_lambert_gets_the_least_squares_albedo(scene, whole):
    _, rows, _, _ = whole
    renderer = next(r for r in rows if r.name == "lunar_lambert").renderer
    batch = read_batch(scene, np.flatnonzero(scene.split == 0), 1.0)
    x, y = renderer.radiance_factor(batch)[batch.usable].double(), batch.image[batch.usable].double()
    assert float((x * y).sum() / (x * x).sum()) == pytest.approx(1.0, abs=1e-6)  # no further gain lowers the error


def test_a_model_that_is_not_linear_reaches_the_same_optimum(scene):
    train = np.flatnonzero(scene.split == 0)
    model = get_model("M2")
    gram = least_squares.FrameGram(3, 4)
    batch = read_batch(scene, train, 1.0)
    gram.add(unit_images(model, batch), batch.image, batch.usable, batch.frame)
    exact = least_squares.solve_coefficients(gram.gram)
    sample = as_pixels(draw_pixels(batch, 10**6, np.random.default_rng(0)), 10**9)
    assert least_squares.fit_nonlinear(model, sample, calibrated=True) == pytest.approx(exact, abs=1e-6)


def test_nonlinear_fit_finds_planted_hapke_parameters(scene):
    model = get_model("hapke")
    planted = np.array([p.default for p in model.parameters])
    planted[0] = 0.8 * planted[0]
    batch = read_batch(scene, np.flatnonzero(scene.split == 0), 1.0)
    batch.image = Renderer("planted", model, Constant(planted)).radiance_factor(batch)
    sample = as_pixels(draw_pixels(batch, 100, np.random.default_rng(0)), 10**9)
    found = least_squares.fit_nonlinear(model, sample, calibrated=True)
    batch.memo.clear()
    refit = Renderer("refit", model, Constant(found)).radiance_factor(batch)
    spread = float(batch.image[batch.usable].std())
    assert float((refit - batch.image)[batch.usable].square().mean().sqrt()) < 5e-3 * spread


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_nonlinear_fit_is_the_same_to_the_last_bit_wherever_its_pixels_lie(scene, calibrated, monkeypatch):
    """BLAS adds up in another order where arrays begin elsewhere in memory, and a flat valley makes much of it."""
    monkeypatch.setattr(least_squares, "ROUNDS", 30)
    model = get_model("hapke")
    batch = read_batch(scene, np.flatnonzero(scene.split == 0), 1.0)
    sample = draw_pixels(batch, 200, np.random.default_rng(0))
    found = least_squares.fit_nonlinear(model, as_pixels(sample), calibrated, HAPKE_FREE)
    for places in (1, 3):
        moved = torch.cat([sample[:, :places], sample], dim=1)[:, places:]
        again = least_squares.fit_nonlinear(model, as_pixels(moved), calibrated, HAPKE_FREE)
        np.testing.assert_array_equal(again, found)
    default = np.array([p.default for p in model.parameters])
    assert (np.abs(found - default) > 1e-3).sum() >= 2


def _uncalibrated(scene, gain, offset):
    """The same scene on film: DN with a gain and an offset per frame, not rounded."""
    import dataclasses

    images = gain[scene.frame][:, None, None] * scene.images + offset[scene.frame][:, None, None]
    return dataclasses.replace(scene, images=images.astype(np.float32))


def test_dn_images_are_scored_in_shares_of_the_full_range(scene):
    gain, offset = np.array([900.0, 1200.0, 700.0, 1000.0]), np.array([20.0, -5.0, 40.0, 0.0])
    film = _uncalibrated(scene, gain, offset)
    result, rows, _, scale = _evaluate(film, "dn", only=("learned", "kernels"))
    assert scale == result["dn_full_range"] == 255
    learned = next(r for r in rows if r.name == "learned").renderer
    assert learned.gain * 255 == pytest.approx(gain, rel=0.01)
    assert learned.offset * 255 == pytest.approx(offset, abs=0.8)
    expected = np.mean((gain[film.frame[film.split == 2]] * scene.noise / 255) ** 2)
    assert result["models"]["learned"]["mse"] == pytest.approx(expected, rel=0.05)


def test_every_model_gets_the_nuisances_that_suit_it_best(scene):
    """Frame gains differ by 2 and yet no baseline is punished for it: its residual on train is orthogonal."""
    film = _uncalibrated(scene, np.array([600.0, 1200.0, 800.0, 1000.0]), np.array([9.0, 30.0, 0.0, 5.0]))
    _, rows, _, scale = _evaluate(film, "dn")
    batch = read_batch(film, np.flatnonzero(film.split == 0), scale)
    for row in rows:
        if row.matching is not None:
            continue
        rendered = row.renderer.image(batch)
        for f in range(4):
            use = batch.usable & torch.from_numpy(batch.frame == f)[:, None, None]
            residual = (batch.image - rendered)[use].double()
            assert abs(float(residual.mean())) < 1e-5, row.name
            assert abs(float(np.corrcoef(residual.numpy(), rendered[use].numpy())[0, 1])) < 1e-3, row.name


def test_the_shared_set_of_dn_frames_beats_any_neighbour(scene):
    film = _uncalibrated(scene, np.array([600.0, 1200.0, 800.0, 1000.0]), np.array([9.0, 30.0, 0.0, 5.0]))
    model = get_model("M2")
    batch = read_batch(film, np.flatnonzero(film.split == 0), 255.0)
    gram = least_squares.FrameGram(3, 4)
    gram.add(unit_images(model, batch), batch.image, batch.usable, batch.frame)
    solved = least_squares.solve_uncalibrated(gram.gram, np.array([A, B, C]))

    def loss(coefficients):
        gain, offset = least_squares.solve_gain_offset(gram.gram, coefficients)
        total = 0.0
        for f in range(4):
            v = np.concatenate([-gain[f] * coefficients, [-offset[f], 1.0]])
            total += v @ gram.gram[f] @ v
        return total

    best = loss(solved)
    rng = np.random.default_rng(3)
    for _ in range(50):
        assert loss(solved * (1 + 0.1 * rng.normal(size=3))) >= best * (1 - 1e-7)


def test_frames_without_train_pairs_are_flagged(scene):
    import dataclasses

    film = _uncalibrated(scene, np.array([900.0, 1200.0, 700.0, 1000.0]), np.zeros(4))
    split = film.split.copy()
    split[(film.frame == 3) & (split == 0)] = 1
    film = dataclasses.replace(film, split=split)
    result, rows, _, _ = _evaluate(film, "dn", only=("learned",))
    assert result["frames_fitted_on_split"] == ["frame3"]
    assert any("without train pairs" in w for w in result["warnings"])
    learned = next(r for r in rows if r.name == "learned").renderer
    assert learned.gain[3] * 255 == pytest.approx(1000, rel=0.02)


def test_fit_pairs_are_thinned_alike_over_frames(scene):
    wanted = np.flatnonzero(scene.split == 2)
    train, orphans = choose_fit_pairs(scene, wanted, 12, 0)
    assert len(train) == 12 and not len(orphans)
    assert (np.bincount(scene.frame[train], minlength=4) == 3).all()


def test_a_perfect_rendering_has_no_finite_psnr_and_stays_valid_json(rng):
    scene = make_scene(rng, pairs=12, size=16, noise=0.0)
    wanted = np.flatnonzero(scene.split == 2)
    scene.images[wanted] = 0.0
    scene.mask[wanted] = True

    class Black(KnowsTheTruth):
        def coefficients(self, elevation):
            return super().coefficients(elevation) * 0

    result, *_ = _evaluate(scene, predictor=Black(), only=("learned", "global"))
    assert result["models"]["learned"]["mse"] == 0 and result["models"]["learned"]["psnr"] is None
    json.dumps(result, allow_nan=False)


def test_a_checkpoint_that_renders_nan_is_one_clear_error(scene):
    from schemas import ArtefactError

    class Broken(KnowsTheTruth):
        def coefficients(self, elevation):
            return super().coefficients(elevation) * float("nan")

    with pytest.raises(ArtefactError, match="finite"):
        _evaluate(scene, predictor=Broken(), only=("learned", "global"))


def test_shared_illumination_gives_what_the_formation_chain_gives(scene):
    import dataclasses

    from stages.evaluate.renderers import shade
    from stages.physics.formation.chain import form, illuminate

    observation = scene.observation(np.arange(6))
    horizon = torch.linspace(0.0, 1.2, 32).expand(6, 32, 32)
    observation = dataclasses.replace(observation, sun_horizon=horizon)  # from full light to full shadow
    model = get_model("hapke")
    values = torch.tensor([p.default for p in model.parameters])[None, :, None, None]
    expected = form(observation, model, values)
    torch.testing.assert_close(shade(illuminate(observation), model, values), expected, rtol=1e-5, atol=1e-7)
    assert (expected == 0).any() and (expected > 0).any()


def test_a_single_tile_gives_flagged_intervals_over_its_sites(scene):
    import dataclasses

    one_tile = dataclasses.replace(scene, tile=np.zeros_like(scene.tile))
    result, *_ = _evaluate(one_tile, only=("learned", "global"))
    row = result["models"]["learned"]
    assert result["tiles"] == 1 and result["interval_unit"] == "site"
    assert row["mse_low"] < row["mse"] < row["mse_high"]
    assert any("too narrow" in w for w in result["warnings"])


def test_global_kernels_and_fitted_hapke_are_least_squares_fits_of_the_train_split(scene):
    """On images of a planted Hapke law, fitted Hapke finds it and kernels come near; on those of M2 kernels contain it."""
    import dataclasses

    model = get_model("hapke")
    planted = np.array([p.default for p in model.parameters])
    planted[[0, 1, 7]] = 0.25, 0.3, np.radians(12)  # w, b, theta
    everything = np.arange(len(scene.split))
    batch = read_batch(scene, everything, 1.0)
    images = Renderer("planted", model, Constant(planted)).radiance_factor(batch).numpy()
    of_hapke = dataclasses.replace(scene, images=images + 1e-4 * np.random.default_rng(0).normal(size=images.shape))
    of_hapke.images = of_hapke.images.astype(np.float32)
    models = _evaluate(of_hapke, only=("hapke_fitted", "kernels", "hapke_raw", "lunar_lambert"))[0]["models"]
    assert models["hapke_fitted"]["mse"] == pytest.approx(1e-8, rel=0.1)
    assert models["kernels"]["mse"] < 1e-3 * models["lunar_lambert"]["mse"]
    assert models["hapke_raw"]["mse"] > 100 * models["hapke_fitted"]["mse"]
    of_m2 = _evaluate(scene, only=("global", "kernels"))[0]["models"]
    assert of_m2["kernels"]["mse"] <= 1.02 * of_m2["global"]["mse"]


def test_hapke_s_published_parameters_are_those_of_the_images_wavelength_or_as_asked(scene):
    def published(nm, **options):
        result, rows, *_ = _evaluate(replace(scene, wavelength_nm=nm), only=("hapke_raw",), **options)
        return result["hapke_set"], float(rows[0].renderer.coefficients(None)[0, 0, 0, 0])  # w

    assert published(math.nan) == ("sato2014_643nm", pytest.approx(0.38138))
    assert published(420.0) == ("sato2014_415nm", pytest.approx(0.22768))
    assert published(420.0, published="sato2014_643nm_mare") == ("sato2014_643nm_mare", pytest.approx(0.254484))


def test_fits_know_nothing_of_the_scored_split(scene, whole):
    """Other images on the scored split leave every fitted number as it was (but for the last bits of a sum)."""
    import copy

    spoiled = copy.deepcopy(scene)
    spoiled.images[spoiled.split == 2] *= np.float32(3)
    for row, again in zip(whole[1], _evaluate(spoiled)[1], strict=True):
        if not row.name.startswith("learned"):
            values, others = (r.renderer.coefficients(None).ravel().tolist() for r in (row, again))
            assert values == pytest.approx(others, rel=1e-4, abs=1e-6), row.name
            assert row.renderer.scale == pytest.approx(again.renderer.scale, rel=1e-12), row.name


def test_the_strongest_baseline_is_found_and_compared_like_for_like(whole):
    result, *_ = whole
    models = result["models"]
    free = {n: row["mse"] for n, row in models.items() if row["freedom"] == "none" and n != "learned"}
    matched = {n: row["mse"] for n, row in models.items() if n in MATCHED - {"learned_gain_offset"}}
    assert set(free) == {"global", "kernels", "hapke_fitted", "lunar_lambert", "hapke_raw"}
    assert result["strongest_baseline"] == {
        "none": min(free, key=free.get),
        "gain_offset": min(matched, key=matched.get),
    }
    assert len(result["conclusions"]) == 2
    for kind, ours, sentence in zip(
        ("none", "gain_offset"), ("learned", "learned_gain_offset"), result["conclusions"], strict=True
    ):
        rival = result["strongest_baseline"][kind]
        gain = result["gains"][ours][rival]
        assert f"the strongest baseline, {rival} (" in sentence and f"{gain['gain_percent']:.1f} % lower" in sentence
        assert f"{gain['gain_percent_low']:+.1f} .. {gain['gain_percent_high']:+.1f};" in sentence
        assert "30 pairs on 15 ground tiles, 1 training run" in sentence


def test_a_learned_row_that_is_no_better_is_not_praised(scene):
    class Flat(KnowsTheTruth):
        """One set for all ground: the true mean coefficients."""

        def coefficients(self, elevation):
            return super().coefficients(elevation * 0)

    class Dark(Flat):
        def coefficients(self, elevation):
            return 0.5 * super().coefficients(elevation)

    for predictor, words in ((Flat(), "shows no sure difference from"), (Dark(), "% higher than")):
        only = ("learned", "global")
        result, *_ = _evaluate(scene, predictor=predictor, only=only)
        assert words in result["conclusions"][0]


@pytest.mark.parametrize("units", ["iof", "dn"])
def test_the_intervals_that_networks_predict_are_counted_over_all_runs(scene, units):
    """True coefficients: the images' noise is all there is. A second run that allows for none of it holds no pixel."""

    class Unsure(KnowsTheTruth):
        def __init__(self, factor):
            super().__init__()
            self.image_noise = factor * scene.noise

        def coefficients_and_deviations(self, elevation):
            return self.coefficients(elevation), {"a": torch.full_like(elevation, 1e-9)}

    gain = 100.0 if units == "dn" else 1.0
    images = replace(scene, images=(gain * scene.images).astype(np.float32))
    result, *_ = _evaluate(images, units, Unsure(1.0), only=("learned", "global"))
    found = result["coverage_percent"]
    assert found["pixels"] == result["valid_pixels"]
    assert found["68"] == pytest.approx(68, abs=1) and found["95"] == pytest.approx(95, abs=1)
    seen = [band for band in found["by_incidence"] if band["pixels"] > 2000]
    assert len(seen) > 2 and all(band["95"] == pytest.approx(95, abs=1.5) for band in seen)
    both, *_ = _evaluate(images, units, [Unsure(1.0), Unsure(1e-3)], only=("learned", "global"))
    assert both["coverage_percent"]["pixels"] == 2 * found["pixels"]
    assert both["coverage_percent"]["95"] == pytest.approx(found["95"] / 2, abs=0.5)
    json.dumps(both, allow_nan=False)


def test_networks_that_predict_no_deviations_have_no_coverage(whole):
    assert whole[0]["coverage_percent"] is None


def test_training_runs_are_averaged_and_their_spread_widens_the_interval(scene):
    class Biased(KnowsTheTruth):
        def __init__(self, factor):
            super().__init__()
            self.factor = factor

        def coefficients(self, elevation):
            return self.factor * super().coefficients(elevation)

    factors = (1.05, 1.06, 1.07)
    single = [_evaluate(scene, predictor=Biased(f), only=("learned", "global"))[0] for f in factors]
    result, _, scores, _ = _evaluate(scene, predictor=[Biased(f) for f in factors], only=("learned", "global"))
    row, errors = result["models"]["learned"], [s["models"]["learned"]["mse"] for s in single]
    assert row["mse_runs"] == pytest.approx(errors) and row["mse"] == pytest.approx(np.mean(errors))
    assert row["mse_run_std"] == pytest.approx(np.std(errors, ddof=1))
    assert row["mse_high"] / row["mse_low"] > 2 * max(
        s["models"]["learned"]["mse_high"] / s["models"]["learned"]["mse_low"] for s in single
    )
    gain = result["gains"]["learned"]["global"]
    assert gain["gain_percent"] == pytest.approx(100 * (1 - row["mse"] / result["models"]["global"]["mse"]))
    assert result["models"]["global"] == single[0]["models"]["global"]
    assert result["training_runs"] == 3 and scores.runs("learned").shape == (3, 30)
    assert any("one training run" in w for w in single[0]["warnings"])
    assert not any("training run" in w for w in result["warnings"])


def test_tiles_are_the_witnesses_and_rows_are_paired_by_them(scene, whole):
    """The table's intervals are those over ground tiles, not over crops; gains are ratios tile by tile."""
    result, _, scores, _ = whole
    tile, crop = scene.tile[scene.split == 2], np.arange(30)
    totals, rival = scores.runs("learned"), scores.runs("global")
    row, gain = result["models"]["learned"], result["gains"]["learned"]["global"]
    by_tile, by_crop = (ratio_interval(totals, scores.pixels, unit, ERROR) for unit in (tile, crop))
    assert (row["mse_low"], row["mse_high"]) == pytest.approx((by_tile.low, by_tile.high), rel=1e-9)
    assert by_crop.low != pytest.approx(by_tile.low, rel=1e-4)
    paired = ratio_interval(totals, rival, tile, LOG)
    assert gain["gain_percent_low"] == pytest.approx(100 * (1 - paired.high), rel=1e-9)
    assert gain["gain_percent_high"] == pytest.approx(100 * (1 - paired.low), rel=1e-9)


def test_ssim_takes_the_range_of_the_measured_crop(scene, whole):
    _, rows, scores, _ = whole
    wanted = np.flatnonzero(scene.split == 2)
    batch = read_batch(scene, wanted[:3], 1.0)
    row = next(k for k, r in enumerate(rows) if r.name == "global")
    rendered = rows[row].renderer.image(batch, None).numpy()
    for b in range(3):
        measured, usable = scene.images[wanted[b]], scene.mask[wanted[b]]
        span = float(measured[usable].max() - measured[usable].min())
        assert 0.02 < span < 0.3
        assert scores.ssim[row, b] == pytest.approx(ssim(measured, rendered[b], usable, span), rel=1e-6)
        assert scores.ssim_range_1[row, b] == pytest.approx(ssim(measured, rendered[b], usable, 1.0), rel=1e-6)
        assert scores.ssim[row, b] < scores.ssim_range_1[row, b]
