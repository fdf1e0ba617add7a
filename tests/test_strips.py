"""A network in strips is the network: at the map's edges, inside, whatever the strips; parts are the same to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.infer.parallel import run_in_threads
from stages.infer.terrain import TerrainReader, valid_part
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.mapper import Mapper
from stages.network.predictor import Predictor
from stages.network.unet import WIDTHS, UNet
from stages.pairs.holes import fill_holes
from stages.physics.photometry import get_model

SMALL = (4, 4, 6, 6, 8)
WHOLE = (0, 0, 630, 570)


def shaken(widths=SMALL, outputs=3):
    torch.manual_seed(4)
    net = UNet(outputs, widths)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.normal_(module.running_mean, 0, 0.3)
            torch.nn.init.uniform_(module.running_var, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, 0, 0.3)
    torch.nn.init.normal_(net.head.weight, 0, 0.3)
    return Predictor(net, CoefficientMaps(get_model("M2"), (), torch.tensor([0.1, 0.2, 0.3]), 0.5), 2.0).eval()


@pytest.fixture(scope="module")
def terrain():
    return np.random.default_rng(0).normal(size=WHOLE[2:]).astype(np.float32)


def strips(predictor, z, part, precision="fp32", threads=1):
    mapper = Mapper(predictor, torch.device("cpu"), precision, threads)
    reader = TerrainReader(z, np.ones(z.shape, np.uint8))
    rows, values = zip(*mapper.strips(reader, z.shape, part), strict=True)
    assert list(rows) == [part[0] + sum(v.shape[1] for v in values[:k]) for k in range(len(values))]
    return np.concatenate(values, axis=1)


@pytest.mark.parametrize("threads", [1, 4])
@pytest.mark.parametrize(
    "part", [WHOLE, (200, 180, 77, 130), (0, 0, 100, 90), (300, 0, 330, 570), (629, 569, 1, 1), (33, 200, 500, 101)]
)
def test_a_part_is_what_the_whole_has_there(terrain, part, threads):
    predictor = shaken()
    row, col, height, width = part
    whole = predictor.coefficients(torch.from_numpy(terrain)[None])[0].numpy()
    got = strips(predictor, terrain, part, threads=threads)
    np.testing.assert_allclose(got, whole[:, row : row + height, col : col + width], rtol=1e-4, atol=1e-5)


@pytest.fixture
def several_threads():
    """PyTorch with three threads, among which it would share out a convolution."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("widths", "precision"),
    [(SMALL, "fp32"), (SMALL, "bf16"), (WIDTHS, "fp32"), pytest.param(WIDTHS, "bf16", marks=pytest.mark.slow)],
)
def test_cuts_leave_no_trace(terrain, widths, precision, several_threads):
    """Not a bit of the kernels' own, and of the convolutions far less than 1e-4 of a coefficient's spread."""
    predictor = shaken(widths)
    whole = strips(predictor, terrain, WHOLE, precision)
    spread = whole.std(axis=(1, 2))[:, None, None]
    for row, col, height, width in [(160, 64, 131, 333), (401, 300, 229, 270)]:
        part = strips(predictor, terrain, (row, col, height, width), precision, threads=4)
        assert (np.abs(part - whole[:, row : row + height, col : col + width]) < 1e-4 * spread).all()


def test_bf16_keeps_the_coefficients(terrain):
    predictor = shaken(WIDTHS)
    exact, short = (strips(predictor, terrain, WHOLE, precision) for precision in ("fp32", "bf16"))
    assert (np.sqrt(np.square(short - exact).mean(axis=(1, 2))) < 0.02 * exact.std(axis=(1, 2))).all()


def test_height_itself_leaves_nothing(terrain):
    """The same bits on a mountain, as far as float32 holds its height."""
    fine = np.round(terrain * 64) / 64
    np.testing.assert_array_equal(strips(shaken(), fine, WHOLE), strips(shaken(), fine + np.float32(4096), WHOLE))


def test_terrain_is_read_as_if_filled_in_one_piece(monkeypatch):
    rng = np.random.default_rng(1)
    z = rng.normal(size=(700, 300)).cumsum(axis=0).astype(np.float32)
    valid = np.ones(z.shape, np.uint8)
    valid[300:320, 100:140] = 0
    valid[0:5] = 0
    whole = np.pad(fill_holes(z, valid.astype(bool)), ((1, 20), (0, 4)), mode="edge")
    monkeypatch.setattr("stages.infer.terrain.READ", 64)
    reader = TerrainReader(z, valid)
    for first in range(-1, 720, 37):
        last = min(720, first + 41)
        np.testing.assert_allclose(reader(first, last, 0, 304), whole[first + 1 : last + 1], rtol=1e-5, atol=1e-4)


def test_what_is_not_valid_is_not_worked_on():
    valid = np.zeros((3000, 50), np.uint8)
    assert valid_part(valid, (0, 0, 3000, 50)) is None
    valid[1500:2100, 20] = 1
    assert valid_part(valid, (10, 5, 2900, 40)) == (1498, 13, 608, 8)  # in steps of eight from the box's corner


def test_side_by_side_hands_over_everything_and_every_error():
    def work(job):
        yield from range(job)
        if job == 9:
            raise ValueError("nine")

    torch.set_num_threads(threads := torch.get_num_threads())
    found = list(run_in_threads([3, 0, 5, 2], work, 3))
    for number, count in enumerate([3, 0, 5, 2]):
        assert [item for job, item in found if job == number] == [*range(count), None]
    with pytest.raises(ValueError, match="nine"):
        list(run_in_threads([1, 9, 4], work, 2))
    assert torch.get_num_threads() == threads
    jobs = run_in_threads([1000] * 3, work, 2)
    next(jobs)
    jobs.close()  # an interruption: no thread stays behind
    import threading

    assert not [t for t in threading.enumerate() if t.name.startswith("strips")]
