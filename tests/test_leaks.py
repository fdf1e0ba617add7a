"""What is learned and fitted hangs on training pairs alone: the others are changed, and not a bit of it may move."""

from __future__ import annotations

import copy
import dataclasses
import json
import math

import h5py
import numpy as np
import pytest
import torch
from evaluation_scene import KnowsTheTruth, make_scene, write_pairs

from stages import train
from stages.evaluate.config import Config
from stages.evaluate.renderers import read_batch
from stages.evaluate.task import Task, score_here
from stages.pairs.reader import PairReader
from stages.train.epoch import evaluate_loss, learn_epoch
from stages.train.training import set_up

GAINS = np.array([900.0, 1400.0])  # DN per I/F of the two images
SMALL = {"model": "M2", "widths": (4, 8), "batch": 8, "device": "cpu", "precision": "fp32", "maps": ("a",)}
VALIDATION, TEST = 1, 2


def pairs_of(parts: tuple[int, ...] = ()):
    """A scene in DN: two images, half of its pairs for training. The pairs of ``parts`` have other terrain and images."""
    scene = make_scene(np.random.default_rng(11), pairs=32, size=16, frames=2)
    scene.split = np.repeat([0, VALIDATION, TEST], [16, 8, 8]).astype(np.uint8)
    scene.images *= GAINS[scene.frame][:, None, None].astype(np.float32)
    for part in parts:
        other = scene.split == part
        scene.elevation[other] = 3 * scene.elevation[other][:, ::-1] + 5
        scene.images[other] = 2 * scene.images[other][:, :, ::-1] + 40
    return scene


def learned(tmp_path, name: str, scene, epochs: int) -> dict[str, np.ndarray]:
    """All of a checkpoint that training pairs alone may decide."""
    pairs, out = write_pairs(tmp_path / f"{name}.h5", scene, units="dn"), tmp_path / f"{name}_checkpoint.h5"
    train.run(pairs, out, train.Config(**SMALL, epochs=epochs))
    with h5py.File(out) as file:
        found = {f"weights/{n}": data[...] for n, data in file["weights"].items()}
        found |= {n: file[n][...] for n in ("gain", "offset", "train_loss", "validation_loss")}
        found |= {
            n: np.array(file.attrs[n]) for n in ("elevation_scale_m", "output_scale", "best_epoch", "image_noise")
        }
        for n in ("start", "globals"):
            found |= {f"{n}/{k}": np.array(v) for k, v in json.loads(file.attrs[n]).items()}
    return found


def test_test_pairs_change_nothing_of_a_checkpoint(tmp_path):
    plain, changed = (learned(tmp_path, n, pairs_of(p), epochs=2) for n, p in (("plain", ()), ("changed", (TEST,))))
    for name, value in plain.items():
        np.testing.assert_array_equal(changed[name], value, err_msg=name)


def test_validation_pairs_choose_the_epoch_and_scale_the_deviations_and_do_nothing_else(tmp_path):
    """After one epoch there is nothing to choose from."""
    plain = learned(tmp_path, "plain", pairs_of(), epochs=1)
    changed = learned(tmp_path, "changed", pairs_of((VALIDATION, TEST)), epochs=1)
    assert changed.pop("validation_loss") != plain.pop("validation_loss")
    assert changed.pop("image_noise") != plain.pop("image_noise")
    start, other = plain.pop("weights/maps.start"), changed.pop("weights/maps.start")  # maps, then their deviations
    np.testing.assert_array_equal(start[:1], other[:1])
    assert {"start/a", "globals/b", "gain", "elevation_scale_m", "weights/net.head.weight"} <= set(plain)
    for name, value in plain.items():
        np.testing.assert_array_equal(changed[name], value, err_msg=name)
    assert plain["gain"][1] / plain["gain"][0] == pytest.approx(GAINS[1] / GAINS[0], rel=0.1)


def test_the_best_epoch_is_that_of_the_lowest_validation_loss(tmp_path, monkeypatch):
    """Of what is minimised, there: training and squared errors fall all along; the checkpoint holds the second epoch."""
    validation = [3.0, 1.0, 2.0, 4.0]
    name, written = None, []

    def learn(training, indices, config, epoch, progress=None):
        nonlocal name
        name, weight = next((n, p) for n, p in training.predictor.named_parameters() if n.startswith("net."))
        with torch.no_grad():
            weight.fill_(0.01 * (epoch + 1))
        written.append(epoch)
        return 10.0 - epoch

    monkeypatch.setattr("stages.train.stage.learn_epoch", learn)
    monkeypatch.setattr(
        "stages.train.stage.evaluate_loss", lambda training, *_: (9.0 - written[-1], validation[written[-1]])
    )
    pairs = write_pairs(tmp_path / "pairs.h5", pairs_of(), units="dn")
    summary = train.run(pairs, tmp_path / "c.h5", train.Config(**SMALL, epochs=4))
    assert summary.history.best_epoch == 1
    with h5py.File(tmp_path / "c.h5") as file:
        assert file.attrs["best_epoch"] == 2  # counted from 1, as on the terminal
        np.testing.assert_allclose(file["weights"][name][...], 0.02, rtol=1e-6)


def test_validation_runs_without_dropout_and_leaves_the_network_as_it_is(tmp_path):
    """In training mode dropout would draw, and batch normalisation would learn from validation ground."""
    pairs = write_pairs(tmp_path / "pairs.h5", pairs_of(), units="dn")
    config = train.Config(**SMALL, dropout=(0.5,), epochs=1)
    with PairReader(pairs) as reader:
        training = set_up(reader, config, [], torch.device("cpu"), 0, 1)
        learn_epoch(training, reader.indices("train"), config, 0)
        before = {k: v.clone() for k, v in training.predictor.state_dict().items()}
        first, again = (evaluate_loss(training, reader.indices("validation"), 4) for _ in range(2))
        assert first == again and math.isfinite(first[0])
        for key, value in training.predictor.state_dict().items():
            torch.testing.assert_close(value, before[key], rtol=0, atol=0, msg=key)


@pytest.mark.parametrize("units", ["iof", "dn"])
def test_baselines_are_fitted_on_training_pairs_alone(units):
    """Other images on validation and test ground leave what every fitted row renders as it was."""
    scene = make_scene(np.random.default_rng(7), pairs=36, size=16)
    scene.split = np.repeat([0, VALIDATION, TEST], 12).astype(np.uint8)
    if units == "dn":
        scene = dataclasses.replace(scene, images=scene.images * 1000)
    spoiled = copy.deepcopy(scene)
    # within the range of the rest: the full range of DN is the camera's, and looked for in all images
    spoiled.images[spoiled.split != 0] *= np.linspace(0.3, 0.9, 16, dtype=np.float32)
    fitted = []
    for s in (scene, spoiled):
        s = dataclasses.replace(s, units=units)
        rows, _, scale = score_here(Task(s, [KnowsTheTruth()], np.flatnonzero(s.split == TEST), Config(batch=7)))
        fitted.append((rows, scale))
    assert fitted[0][1] == fitted[1][1]
    batch = read_batch(scene, np.flatnonzero(scene.split == 0), fitted[0][1])
    for row, again in zip(fitted[0][0], fitted[1][0], strict=True):
        if units == "dn" and row.name.startswith("hapke_fitted"):
            continue  # gains leave a valley, in which the last bits of sums choose the place: no two runs agree
        first, second = (r.renderer.image(batch, None)[batch.usable].numpy() for r in (row, again))
        np.testing.assert_allclose(second, first, rtol=1e-3, err_msg=row.name)
        assert row.renderer.scale == pytest.approx(again.renderer.scale, rel=1e-9), row.name
