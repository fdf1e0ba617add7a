"""The network sees height differences only, turns with the ground, and is the paper's in size."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from stages.network.coefficient_maps import CoefficientMaps
from stages.network.losses import Radiometry, squared_error
from stages.network.normalisation import scale_elevation
from stages.network.precision import choose_inference_precision
from stages.network.predictor import Predictor
from stages.network.unet import UNet
from stages.pairs.holes import FILL_REACH, fill_holes
from stages.pairs.reader import PairReader
from stages.pairs.symmetries import COUNT, turn_field, turn_vector
from stages.physics.formation.chain import Observation, form
from stages.physics.photometry import get_model, model_names


def test_the_network_has_the_papers_size():
    """2.16 M parameters and 2.05 GFLOP forward at 128 x 128 with three outputs (the authors' public code)."""
    net = UNet(3)
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(2.16e6, rel=5e-3)
    with FlopCounterMode(display=False) as counter:
        net(torch.zeros(1, 1, 128, 128))
    assert counter.get_total_flops() == pytest.approx(2.05e9, rel=0.02)


def test_bf16_keeps_heights_in_float32():
    """In bfloat16 a height of 1000 would lose the slopes; the rest of the network only loses digits."""
    torch.manual_seed(2)
    net = shaken(UNet(2, (8, 16), (0.0,))).train()
    x = torch.randn(4, 1, 32, 32) + 1000
    exact = net(x).detach()
    with torch.autocast("cpu", torch.bfloat16):
        out = net(x)
    out.float().square().mean().backward()
    assert out.dtype == torch.bfloat16
    assert (out.float() - exact).square().mean().sqrt() < 0.02 * exact.square().mean().sqrt()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def shaken(net):
    """A network whose head, zero before training, says something."""
    torch.nn.init.normal_(net.head.weight)
    return net


def test_height_itself_does_not_matter():
    torch.manual_seed(0)
    net = shaken(UNet(3)).eval()
    z = torch.randn(2, 64, 64) * 10
    with torch.no_grad():
        low, high = net(scale_elevation(z, 30.0)), net(z.unsqueeze(1) / 30 + 1.0)
    torch.testing.assert_close(low, high, atol=2e-5, rtol=1e-4)


def test_outputs_depend_on_nothing_beyond_reach():
    """A change at one pixel moves outputs only within ``reach``; and shifts by ``stride`` shift the output."""
    torch.manual_seed(0)
    net = shaken(UNet(2, widths=(4, 4, 4, 4, 4), dropout=(0.0,) * 5)).eval()
    z = torch.randn(1, 1, 512, 512)
    changed = z.clone()
    changed[0, 0, 256, 256] += 5
    with torch.no_grad():
        difference = (net(z) - net(changed)).abs().amax(dim=(0, 1))
        rolled = net(torch.roll(z, (net.stride, 2 * net.stride), (2, 3)))
        original = torch.roll(net(z), (net.stride, 2 * net.stride), (2, 3))
    rows = torch.nonzero(difference > 0)
    assert (rows - 256).abs().max() <= net.reach
    assert (rows - 256).abs().max() > net.reach // 2
    inner = slice(net.reach + 32, 512 - net.reach - 32)
    torch.testing.assert_close(rolled[..., inner, inner], original[..., inner, inner], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("contrast", "expected"), [(1.0, "bf16"), (1e-4, "fp32")])
def test_bf16_is_refused_where_it_would_drown_the_coefficients(contrast, expected, monkeypatch):
    """A map that hardly varies about a large mean has nothing left of its spread in three digits."""
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    torch.manual_seed(5)
    net = shaken(UNet(1, (8, 16)))
    with torch.no_grad():
        net.head.weight *= contrast
        net.head.bias += 1
    predictor = Predictor(net, CoefficientMaps(get_model("lambert"), (), torch.tensor([0.5]), 1.0), 1.0)
    sample = (torch.randn(64, 64).cumsum(0).cumsum(1) * 0.1).numpy()
    assert choose_inference_precision(predictor, sample, torch.device("cpu")) == expected


@pytest.mark.parametrize("symmetry", range(COUNT))
@pytest.mark.parametrize("name", ["M2", "M6", "lunar_lambert", "hapke"])
def test_rendering_commutes_with_the_symmetries(symmetry, name, rng):
    """Turning terrain, Sun and camera, then rendering, is rendering, then turning."""
    if name not in model_names():
        pytest.fail(f"{name} is not registered")
    model = get_model(name)
    z = torch.from_numpy(rng.normal(size=(1, 32, 32)).cumsum(1).cumsum(2).astype(np.float32)) * 0.3
    sun = torch.tensor([[0.5, 0.3, 0.6]])
    sun = sun / sun.norm()
    camera = torch.tensor([[2e4, -3e4, 8e4]])
    horizon = torch.from_numpy(rng.uniform(0.3, 1.2, (1, 32, 32)).astype(np.float32))
    coefficients = torch.tensor([p.default for p in model.parameters]).view(1, -1, 1, 1)

    def render(z, sun, camera, horizon):
        return form(Observation(z, sun, camera, 5.0, 1737400.0, sun_horizon=horizon), model, coefficients)

    turned = render(
        turn_field(z, symmetry),
        turn_vector(sun, symmetry),
        turn_vector(camera, symmetry),
        turn_field(horizon, symmetry),
    )
    torch.testing.assert_close(turned, turn_field(render(z, sun, camera, horizon), symmetry), atol=2e-6, rtol=2e-4)


def test_the_eight_symmetries_are_eight():
    field = torch.arange(16.0).view(4, 4)
    assert len({tuple(turn_field(field, k).flatten().tolist()) for k in range(COUNT)}) == COUNT


def test_holes_are_filled_alike_in_every_window(rng):
    z = rng.normal(size=(700, 700)).cumsum(0).cumsum(1).astype(np.float32)
    valid = np.ones(z.shape, bool)
    valid[330:420, 300:420] = False
    whole = fill_holes(np.where(valid, z, np.nan), valid)
    window = np.s_[120:640, 100:660]
    part = fill_holes(np.where(valid, z, np.nan)[window], valid[window])
    inner = np.s_[FILL_REACH:-FILL_REACH, FILL_REACH:-FILL_REACH]
    np.testing.assert_array_equal(part[inner], whole[window][inner])
    assert np.isfinite(whole).all()
    np.testing.assert_array_equal(whole[valid], z[valid])


def test_loss_counts_valid_pixels_only():
    predicted, measured = torch.zeros(1, 2, 2), torch.tensor([[[1.0, 2.0], [1e9, 3.0]]])
    valid = torch.tensor([[[True, True], [False, False]]])
    assert squared_error(predicted, measured, valid).item() == pytest.approx(2.5 * valid.sum().item())
    assert squared_error(predicted, measured, torch.zeros_like(valid)).item() == 0


def test_the_gradient_of_the_loss_is_that_of_its_value(rng):
    predicted, measured = (torch.from_numpy(rng.random((2, 3, 4))) for _ in range(2))
    valid = torch.from_numpy(rng.random((2, 3, 4)) > 0.3)
    assert torch.autograd.gradcheck(lambda p: squared_error(p, measured, valid), predicted.requires_grad_())


def test_radiometry_is_gain_and_offset_and_leaves_calibrated_images_alone():
    gain, offset = torch.tensor([100.0, 400.0]), torch.tensor([3.0, -5.0])
    radiometry = Radiometry(gain, offset, calibrated=False)
    torch.testing.assert_close(radiometry.gain(), gain)
    torch.testing.assert_close(radiometry.offset(), offset)
    crop_gain, crop_offset = radiometry.crop_gains(torch.tensor([0, 1]))
    out = (crop_gain * torch.full((2, 1, 1), 0.1) + crop_offset) * radiometry.scale
    torch.testing.assert_close(out.flatten(), torch.tensor([13.0, 35.0]))
    iof = Radiometry(torch.ones(2), torch.zeros(2), calibrated=True)
    assert not any(p.requires_grad for p in iof.parameters())


def test_weights_that_do_not_fit_are_named(small_checkpoint, tmp_path):
    """PyTorch's first line, 'Error(s) in loading state_dict', tells nobody what to do."""
    import h5py

    from schemas import ArtefactError
    from stages.network.predictor import load_predictor

    path = tmp_path / "checkpoint.h5"
    shutil.copy(small_checkpoint, path)
    with h5py.File(path, "a") as file:
        name = next(iter(file["weights"]))
        del file[f"weights/{name}"]
    with pytest.raises(ArtefactError, match=rf"{name}.*train again") as error:
        load_predictor(path)
    assert "state_dict" not in str(error.value)


def test_turned_batches_render_as_turned_images(small_artefacts):
    """Augmentation turns terrain, horizon, image, Sun and camera alike: what a batch renders turns with its image."""
    turns = np.arange(COUNT)
    model = get_model("M2")
    coefficients = torch.tensor([0.09, 0.03, 0.01]).view(1, -1, 1, 1)
    with PairReader(small_artefacts["pairs"]) as reader:
        plain, turned = reader.batch(turns), reader.batch(turns, turns)
    images = [form(batch.observation, model, coefficients) for batch in (plain, turned)]
    for k in turns.tolist():
        torch.testing.assert_close(turned.image[k], turn_field(plain.image[k], k), rtol=0, atol=0)
        torch.testing.assert_close(turned.valid[k], turn_field(plain.valid[k], k), rtol=0, atol=0)
        torch.testing.assert_close(images[1][k], turn_field(images[0][k], k), rtol=1e-4, atol=1e-6)


def test_holes_continue_the_terrain_around_them():
    """On a slope a small hole is filled with heights of its rim, not with 0."""
    z = np.broadcast_to(1000 + 2.0 * np.arange(64), (64, 64)).astype(np.float32)
    valid = np.ones(z.shape, bool)
    valid[28:36, 30:34] = False
    filled = fill_holes(np.where(valid, z, np.nan), valid)
    np.testing.assert_array_equal(filled[valid], z[valid])
    assert 1056 <= filled[~valid].min() <= filled[~valid].max() <= 1070
