"""train: it learns, resumes to the same result, refuses what it cannot use."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys

import cv2
import h5py
import numpy as np
import pytest
import small_scene
import torch

from schemas import PAIRS, ArtefactError, ArtefactWriter, ConfigError, InputError, RegistryError
from schemas.files.outputs import Output
from stages import ingest, project, sample, train
from stages.common.threads import one_thread
from stages.network.predictor import load_predictor
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form
from stages.physics.photometry import get_model
from stages.train import stage
from stages.train.epoch import evaluate_loss, learn_epoch
from stages.train.start import fit_radiometry, fit_uniform
from stages.train.steps import order_steps
from stages.train.training import set_up

SMALL = {
    "model": "M2",
    "brightness": 1.0,
    "widths": (4, 8),
    "dropout": (0.0, 0.1),
    "batch": 16,
    "device": "cpu",
    "precision": "fp32",
    "lr": 2e-3,
}


def config(**change):
    return train.Config(**(SMALL | {"epochs": 3} | change))


@pytest.fixture(scope="module", autouse=True)
def on_one_thread():
    """Weights depend, by rounding, on the number of threads."""
    with one_thread():
        yield


@pytest.fixture(scope="module")
def trained(small_artefacts, tmp_path_factory):
    path = tmp_path_factory.mktemp("train") / "checkpoint.h5"
    summary = train.run(small_artefacts["pairs"], path, config(epochs=4))
    return path, summary


def weights(path):
    with h5py.File(path) as file:
        return {name: data[...] for name, data in file["weights"].items()}


def test_uniform_fit_finds_the_truth(small_artefacts):
    """The images are M2 with known coefficients; the fit sees them through area means, so to a few per cent."""
    with PairReader(small_artefacts["pairs"]) as reader:
        train_pairs = reader.indices("train")
        found = fit_uniform(reader, train_pairs, get_model("M1"), fit_radiometry(reader, train_pairs))
        batch = reader.batch(train_pairs[:32])
        image = form(batch.observation, get_model("M1"), found.view(1, -1, 1, 1))
        assert found[0].item() == pytest.approx(small_scene.A, rel=0.03)
        rms = ((image - batch.image) * batch.valid).square().mean().sqrt().item()
    assert rms < 1e-3


def test_it_learns_what_a_uniform_surface_cannot_show(tmp_path):
    """Albedo that follows height: the network finds it on ground it never saw, a uniform surface cannot."""
    rng = np.random.default_rng(4)
    n, size = 96, 32
    z = rng.normal(size=(n, size + 16, size + 16))
    z = np.stack([cv2.GaussianBlur(layer, (0, 0), 3) * 60 for layer in z])[:, 8:-8, 8:-8]
    east = np.gradient(z, 20.0, axis=2)
    north = -np.gradient(z, 20.0, axis=1)
    sun = np.array([0.5, 0.2, 0.0])
    sun[2] = np.sqrt(1 - sun @ sun)
    mu0 = (sun[2] - east * sun[0] - north * sun[1]) / np.sqrt(1 + east**2 + north**2)
    albedo = 0.10 * (1 + 0.5 * np.tanh(4 * np.hypot(east, north) - 1))  # steep ground is bright
    image = np.where(mu0 > 0, albedo * mu0, 0)
    path = tmp_path / "pairs.h5"
    sizes = {"pair": n, "y": size, "x": size, "enu": 3, "frame": 1}
    with ArtefactWriter(path, PAIRS, sizes, attributes={"gsd_m": 20.0, "body_radius_m": 1e9}) as writer:
        for name, data in {
            "elevation": z, "image": image, "valid": np.ones(z.shape), "sun_horizon_deg": np.full(z.shape, -90.0), "sun_direction_enu": np.tile(sun, (n, 1)),
            "camera_position_enu": np.tile([0.0, 0, 1e8], (n, 1)), "longitude_deg": np.zeros(n), "latitude_deg": np.zeros(n),
            "image_index": np.zeros(n), "site": np.arange(n), "split": np.repeat([0, 1, 2], [64, 16, 16]),
        }.items():  # fmt: skip
            writer.write(name, data)
        writer.write("image_id", ["A"])
    out = tmp_path / "checkpoint.h5"
    train.run(path, out, config(model="M1", epochs=15, lr=8e-3, widths=(8, 16)))
    predictor = load_predictor(out)
    with PairReader(path) as reader:
        batch = reader.batch(reader.indices("test"))
        start = fit_uniform(
            reader, reader.indices("train"), predictor.model, fit_radiometry(reader, reader.indices("train"))
        )
        learned = form(batch.observation, predictor.model, predictor.coefficients(batch.observation.elevation))
        uniform = form(batch.observation, predictor.model, start.view(1, -1, 1, 1))
    assert (learned - batch.image).square().mean() < 0.2 * (uniform - batch.image).square().mean()


def test_the_checkpoint_says_what_it_is(trained):
    path, summary = trained
    assert len(summary.history.train_loss) == 4
    with h5py.File(path) as file:
        assert file.attrs["model"] == "M2"
        assert file["train_loss"].shape == (4,)
        np.testing.assert_array_equal(file["gain"][...], 1)


def test_same_seed_same_weights(small_artefacts, trained, tmp_path):
    train.run(small_artefacts["pairs"], tmp_path / "again.h5", config(epochs=4))
    first, again = weights(trained[0]), weights(tmp_path / "again.h5")
    for name in first:
        np.testing.assert_array_equal(first[name], again[name], err_msg=name)


def test_killed_and_resumed_is_uninterrupted(small_artefacts, trained, tmp_path):
    """SIGKILL after the second epoch, then --resume: bit for bit the uninterrupted checkpoint."""
    out = tmp_path / "checkpoint.h5"
    words = [
        "train", str(small_artefacts["pairs"]), "-o", str(out), "--epochs", "4", "--batch", "16", "--widths", "4-8", "--lr", "2e-3",
        "--device", "cpu", "--precision", "fp32", "--dropout", "0-0.1", "--resume", "--model", "M2", "--brightness", "1",
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "lunargr_cli.main", *words]
    child = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=environment)
    assert child.stderr is not None
    for said in child.stderr:
        if said.startswith("epoch   2/4"):
            child.send_signal(signal.SIGKILL)
            break
    child.stderr.close()
    child.wait()
    assert not out.exists()
    subprocess.run(line, check=True, capture_output=True, env=environment)
    first, again = weights(trained[0]), weights(out)
    for name in first:
        np.testing.assert_array_equal(first[name], again[name], err_msg=name)
    assert not list(tmp_path.glob("*.resume.h5"))


@pytest.mark.parametrize(("schedule", "longer"), [("constant", True), ("cosine", False)])
def test_a_cosine_is_not_resumed_with_another_number_of_epochs(
    small_artefacts, tmp_path, monkeypatch, schedule, longer
):
    """What it did in its first epochs hangs on how many there were to be; a constant rate goes on."""
    out = tmp_path / "checkpoint.h5"

    def stop(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stage, "write_checkpoint", stop)
        train.run(small_artefacts["pairs"], out, config(epochs=1, schedule=schedule))
    again = (small_artefacts["pairs"], Output(out, resume=True), config(epochs=2, schedule=schedule))
    if longer:
        assert len(train.run(*again).history.train_loss) == 2
    else:
        with pytest.raises(ArtefactError, match="other options"):
            train.run(*again)


def test_the_state_of_an_unfinished_run_is_not_lost_by_a_forgotten_option(tmp_path):
    """Hours of work: before any pair is read."""
    side = tmp_path / "checkpoint.resume.h5"
    side.write_text("state")
    with pytest.raises(ConfigError, match=r"checkpoint\.resume\.h5: the state of an unfinished run; add `resume`"):
        train.run(tmp_path / "pairs.h5", tmp_path / "checkpoint.h5", config(epochs=1))
    assert side.read_text() == "state"


def test_resume_refuses_another_run(small_artefacts, tmp_path):
    out = tmp_path / "checkpoint.h5"
    train.run(small_artefacts["pairs"], out, config(epochs=1))
    side = tmp_path / "checkpoint.resume.h5"
    shutil.copy(out, side)
    with pytest.raises(ArtefactError, match="cannot be resumed"):
        train.run(small_artefacts["pairs"], Output(out, overwrite=True, resume=True), config(epochs=1))
    assert out.exists()


def test_uncalibrated_images_get_their_gains(tmp_path):
    truth = [(900.0, 10.0), (1400.0, -20.0), (600.0, 40.0)]
    files = small_scene.write_scene(tmp_path / "f", gain=truth)
    ingest.run(files.dem, files.images, tmp_path / "s.h5", ingest.Config(crop=32))
    sample.run(tmp_path / "s.h5", tmp_path / "c.h5", sample.Config(count=90, tile_m=1280))
    project.run(tmp_path / "c.h5", tmp_path / "p.h5", project.Config())
    train.run(tmp_path / "p.h5", tmp_path / "k.h5", config(epochs=6, model="M1"))
    with h5py.File(tmp_path / "k.h5") as file:
        gain = file["gain"][...]
        assert file.attrs["image_units"] == "dn"
    np.testing.assert_allclose(gain / gain[0], np.array([t[0] for t in truth]) / truth[0][0], rtol=0.05)


@pytest.mark.slow
def test_two_processes_learn_like_one(small_artefacts, tmp_path):
    """torchrun with two processes: each normalises by its half of a batch, and learns as well within a fifth."""
    out = tmp_path / "checkpoint.h5"
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "lunargr_cli.main", "train",
        str(small_artefacts["pairs"]), "-o", str(out), "--epochs", "4", "--batch", "16", "--widths", "4-8", "--lr", "2e-3", "--device", "cpu",
        "--precision", "fp32", "--model", "M2", "--brightness", "1", "--dropout", "0.1",
    ]  # fmt: skip
    train.run(small_artefacts["pairs"], tmp_path / "one.h5", config(epochs=4, dropout=(0.1,)))
    subprocess.run(command, check=True, capture_output=True, timeout=240)
    with h5py.File(out) as two, h5py.File(tmp_path / "one.h5") as one:
        for name in ("train_loss", "validation_loss"):
            np.testing.assert_allclose(two[name][...], one[name][...], rtol=0.2, err_msg=name)


def test_bad_requests_are_refused_and_leave_nothing(small_artefacts, tmp_path):
    out = tmp_path / "c.h5"
    pairs = small_artefacts["pairs"]
    for options, kind, words in [
        ({"model": "M9"}, RegistryError, "choose one of"),
        ({"lr": -1.0}, ConfigError, "`lr`"),
        ({"epochs": 0}, ConfigError, "`epochs`"),
        ({"widths": (4,) * 7, "dropout": (0.0,)}, ConfigError, "multiple of 64"),
        ({"schedule": "steps"}, ConfigError, "`schedule`"),
        ({"device": "abacus"}, ConfigError, "`device`"),
    ]:
        with pytest.raises(kind, match=words):
            train.run(pairs, out, config(**options))
    empty = tmp_path / "empty.h5"
    shutil.copy(pairs, empty)
    with h5py.File(empty, "r+") as file:
        file["split"][...] = 1
    with pytest.raises(InputError, match="expected training pairs"):
        train.run(empty, out, config())
    with pytest.raises(ArtefactError, match="expected a 'pairs'"):
        train.run(small_artefacts["scene"], out, config())
    assert not out.exists()


def test_checkpoint_for_another_model_is_refused(trained):
    with pytest.raises(ArtefactError, match="expected a checkpoint for model 'M4'"):
        load_predictor(trained[0], model="M4")


def test_the_losses_are_means_over_valid_pixels(small_artefacts):
    """Of a network that does not learn, evaluated by hand; the training loss is the same mean without dropout."""
    options = config(augment=False, dropout=(0.0,), batch=7, lr=1e-12)
    with PairReader(small_artefacts["pairs"]) as reader:
        training = set_up(reader, options, [], torch.device("cpu"), 0, 1)
        part = reader.indices("train")[:20]
        training.predictor.eval()
        batch = reader.batch(part)
        rendered = form(
            batch.observation, training.predictor.model, training.predictor.coefficients(batch.observation.elevation)
        )
        expected = (rendered - batch.image)[batch.valid].double().square().mean().item()
        error, objective = evaluate_loss(training, part, 7)
        assert error == objective == pytest.approx(expected, rel=1e-4)
        error, objective = evaluate_loss(training, part, 7, 0.1)
        assert error == pytest.approx(expected, rel=1e-4)
        assert 0.05 * expected < objective < 0.95 * error  # without most of what each crop's own gain explains
        learned = learn_epoch(training, part, options, 0)
        assert learned == pytest.approx(expected, rel=0.5)  # batch normalisation by the batch, not the running mean


@pytest.mark.parametrize(("batch", "ranks"), [(7, 1), (32, 1), (8, 2)])
def test_an_epoch_shows_every_training_pair_once(batch, ranks):
    pairs, shown = np.arange(100, 150), []
    for rank in range(ranks):
        steps = order_steps(pairs, batch, True, np.random.default_rng(3), rank, ranks)
        shown += [k for indices, _ in steps for k in indices.tolist()]
    assert sorted(shown) == pairs.tolist() and shown != pairs.tolist()
