"""Which coefficients are maps and which are global, and their deviations."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import rasterio
import torch
from evaluation_scene import run_command

from schemas import ConfigError, RegistryError, read_strings
from schemas.files.outputs import Output
from stages import infer, train
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.losses import crop_errors, squared_error
from stages.network.pixels import Pixels, fit_pixels
from stages.network.predictor import load_predictor
from stages.pairs.holes import fill_holes
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import get_model, masked_radiance_factor, model_names
from stages.physics.photometry.deviation import radiance_deviation
from stages.train import stage
from stages.train.deviations import _likelihood

SMALL = {"widths": (4, 8), "epochs": 2, "batch": 16, "lr": 5e-3, "device": "cpu", "precision": "fp32"}


@pytest.fixture(scope="module")
def trained(small_artefacts, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "checkpoint.h5"
    train.run(small_artefacts["pairs"], path, train.Config(model="minnaert", **SMALL))
    return path


def weights(path):
    with h5py.File(path) as file:
        return {name: data[...] for name, data in file["weights"].items()}


@pytest.mark.parametrize("name", model_names())
def test_default_maps_are_parameters(name):
    model = get_model(name)
    names = [p.name for p in model.parameters]
    chosen = model.choose_maps()
    assert chosen and set(chosen) <= set(names)
    assert name not in ("M1", "M2", "M3", "M4", "M5", "M6") or list(chosen) == names
    assert model.choose_maps(names[::-1]) == tuple(names)


def test_unknown_maps_list_the_choices(small_artefacts, tmp_path):
    out = tmp_path / "c.h5"
    with pytest.raises(RegistryError, match=r"unknown parameter of hapke 'x'; choose one of: .*theta"):
        train.run(small_artefacts["pairs"], out, train.Config(model="hapke", maps=("w", "x")))
    code, message = run_command("train", small_artefacts["pairs"], "--maps", "w,x", "-o", out)
    assert code == 3 and "\n" not in message and "choose one of" in message
    with pytest.raises(ConfigError, match="`positive`"):
        train.run(small_artefacts["pairs"], out, train.Config(model="hapke", positive=True))
    assert not out.exists()


def test_globals_are_learned_and_constant_in_the_map(small_artefacts, trained, tmp_path):
    """Minnaert's k is one number: it moves with training, stands in the checkpoint by name, and fills its map."""
    with h5py.File(trained) as file:
        assert json.loads(file.attrs["maps"]) == ["albedo"]
        (k,) = json.loads(file.attrs["globals"]).values()
        start = json.loads(file.attrs["start"])
    assert 0 < k < 2 and k != start["k"]
    infer.run(
        small_artefacts["scene"],
        trained,
        tmp_path / "map.h5",
        infer.Config(device="cpu", precision="fp32", geotiff=False),
    )
    with h5py.File(tmp_path / "map.h5") as file:
        valid = file["valid"][...].astype(bool)
        albedo, constant = (plane[valid] for plane in file["coefficients"][...])
    np.testing.assert_allclose(constant, k, rtol=1e-6)
    assert albedo.std() > 0


def test_globals_survive_an_interruption(small_artefacts, trained, tmp_path, monkeypatch):
    """A run that stops after its first epoch goes on to the very same checkpoint."""
    out = tmp_path / "c.h5"
    config = train.Config(model="minnaert", **SMALL)
    monkeypatch.setattr(stage, "learn_epoch", _stop_after_one(stage.learn_epoch))
    with pytest.raises(KeyboardInterrupt):
        train.run(small_artefacts["pairs"], out, config)
    monkeypatch.undo()
    train.run(small_artefacts["pairs"], Output(out, resume=True), config)
    first, again = weights(trained), weights(out)
    for name in first:
        np.testing.assert_array_equal(first[name], again[name], err_msg=name)


def _stop_after_one(learn):
    def learn_or_stop(training, indices, config, epoch, progress=None):
        if epoch:
            raise KeyboardInterrupt
        return learn(training, indices, config, epoch, progress)

    return learn_or_stop


def test_a_crop_that_is_bright_as_a_whole_costs_little(rng):
    rendered = torch.from_numpy(rng.uniform(0.5, 1, (3, 6, 6)))
    valid = torch.from_numpy(rng.random((3, 6, 6)) > 0.2)
    measured = torch.tensor([0.8, 1.0, 1.3], dtype=torch.float64)[:, None, None] * rendered
    plain = squared_error(rendered, measured, valid)
    for share in (0.0, 0.3, 1.0):
        error, told = crop_errors(rendered, measured, valid, share)
        assert error.item() == pytest.approx(share * plain.item(), abs=1e-9)
        assert told.item() == pytest.approx(plain.item())
    noisy = measured + torch.from_numpy(rng.normal(0, 0.1, measured.shape))
    assert torch.autograd.gradcheck(lambda p: crop_errors(p, noisy, valid, 0.3)[0], rendered.requires_grad_())


def test_coefficients_may_be_negative_unless_told_otherwise():
    start = torch.tensor([0.08, 0.02, -0.0084])
    free = CoefficientMaps(get_model("M2"), (), start, 0.1)
    torch.testing.assert_close(free.stack(free.unbounded(torch.zeros(1, 3, 2, 2)), 1)[0, :, 0, 0], start)
    kept = CoefficientMaps(get_model("M2"), (), start.abs(), 0.1, positive=True)
    down = kept.stack(kept.unbounded(torch.full((1, 3, 2, 2), -1.0)), 1)
    assert -0.002 < down.min() < 0


def test_the_best_uniform_surface_of_a_model_that_is_not_linear(rng):
    """Hapke's w and theta come back from pixels at one phase angle, which tell nothing of hc: it stays at its default."""
    model = get_model("hapke")
    i, e = rng.uniform(0, 1.4, 4000), rng.uniform(0, 1.0, 4000)
    azimuth = rng.uniform(0, np.pi, 4000)
    phase = np.cos(i) * np.cos(e) + np.sin(i) * np.sin(e) * np.cos(azimuth)
    angles = Angles(*(torch.from_numpy(v) for v in (np.cos(i), np.cos(e), phase)))
    truth = {p.name: torch.tensor(p.default, dtype=torch.float64) for p in model.parameters}
    truth |= {"w": torch.tensor(0.25, dtype=torch.float64), "theta": torch.tensor(0.3, dtype=torch.float64)}
    image = masked_radiance_factor(model, truth, angles)
    found = dict(zip(truth, fit_pixels(model, Pixels(angles, torch.ones(4000).double(), image)).tolist(), strict=True))
    assert found["w"] == pytest.approx(0.25, rel=0.03) and found["theta"] == pytest.approx(0.3, rel=0.03)
    assert found["hc"] == pytest.approx(1.0, abs=0.01)


def test_an_older_checkpoint_is_refused(trained, tmp_path):
    import shutil

    from schemas import ArtefactError

    old = tmp_path / "old.h5"
    shutil.copy(trained, old)
    with h5py.File(old, "r+") as file:
        del file.attrs["maps"]
    with pytest.raises(ArtefactError, match="maps"):
        load_predictor(old)


def test_deviations_come_back_from_residuals(rng):
    """Errors of two maps, one of them larger where a feature is, and of the image: each finds its own size."""
    n = 20_000
    features = torch.from_numpy(rng.normal(size=(n, 2)))
    effects = torch.from_numpy(rng.uniform(0, 1, (n, 2)) * [1.0, 0.3])
    sigma = torch.stack([0.1 * torch.exp(0.5 * features[:, 0]), torch.full((n,), 0.2)], dim=1)
    errors = torch.from_numpy(rng.normal(size=(n, 2))) * sigma * effects
    residual = errors.sum(dim=1) + 0.02 * torch.from_numpy(rng.normal(size=n))
    weights, constants, noise = _likelihood(residual, effects, features)
    assert constants.exp().tolist() == pytest.approx([0.1, 0.2], rel=0.1)
    assert weights[0, 0].item() == pytest.approx(0.5, abs=0.08) and weights.abs().sum() < 0.8
    assert noise.exp().item() == pytest.approx(0.02, rel=0.1)


def test_the_image_deviation_is_that_of_drawn_parameters(rng):
    model = get_model("hapke")
    angles = Angles(*(torch.tensor(v, dtype=torch.float64) for v in ([0.7, 0.4], [0.95, 0.9], [0.8, 0.5])))
    values = {p.name: torch.tensor(p.default, dtype=torch.float64) for p in model.parameters}
    deviations = {"w": torch.tensor(0.02).double(), "b": torch.tensor(0.01).double()}
    drawn = {k: values[k] + s * torch.from_numpy(rng.normal(size=(40_000, 1))) for k, s in deviations.items()}
    images = masked_radiance_factor(model, {**values, **drawn}, angles)
    found = radiance_deviation(model, values, deviations, angles)
    np.testing.assert_allclose(found.numpy(), images.std(dim=0).numpy(), rtol=0.03)


def test_the_map_carries_its_deviations(small_artefacts, trained, tmp_path):
    """In strips and from a whole window alike, positive, by name; the GeoTIFF has them as bands."""
    infer.run(small_artefacts["scene"], trained, tmp_path / "map.h5", infer.Config(device="cpu", precision="fp32"))
    predictor = load_predictor(trained)
    assert predictor.image_noise > 0
    with h5py.File(small_artefacts["scene"]) as file:
        elevation, known = file["elevation"][...], file["dem_valid"][...].astype(bool)
    coefficients, deviations = predictor.coefficients_and_deviations(
        torch.from_numpy(fill_holes(elevation, known))[None]
    )
    with h5py.File(tmp_path / "map.h5") as file:
        assert read_strings(file, "map_name") == list(deviations) == ["albedo"]
        found = file["coefficients_std"][0]
        np.testing.assert_allclose(file["coefficients"][0][known], coefficients[0, 0].numpy()[known], rtol=1e-4)
        assert file.attrs["image_noise"] == predictor.image_noise
    assert np.isnan(found[~known]).all() and (found[known] > 0).all()
    np.testing.assert_allclose(found[known], deviations["albedo"][0].numpy()[known], rtol=1e-3)
    with rasterio.open(tmp_path / "map.tif") as tiff:
        assert tiff.descriptions == ("albedo", "k", "albedo_std")
        np.testing.assert_array_equal(tiff.read(3), found)
