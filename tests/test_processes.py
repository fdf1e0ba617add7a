"""Several processes learn as one: their gradients, weights, losses and statistics for evaluation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.distributed as dist

from lunargr_cli.console import Console
from stages import train
from stages.pairs.reader import PairReader
from stages.train.epoch import evaluate_loss, learn_epoch
from stages.train.training import set_up

RANKS, BATCHES = 2, (1, 6)


def learn(pairs, rank, ranks, batch):
    """Gradients of the last step of an epoch, its loss, and the validation loss after it."""
    config = train.Config(model="M2", widths=(4, 8), batch=batch, lr=2e-3, device="cpu", precision="fp32")
    with PairReader(pairs) as reader:
        training = set_up(reader, config, [], torch.device("cpu"), rank, ranks)
        chosen = reader.indices("train")[: 3 * batch]
        found = {"loss": learn_epoch(training, chosen, config, 0)}
        found["validation"], _ = evaluate_loss(training, reader.indices("validation")[:8], 4)
        found |= {n: p.grad.numpy() for n, p in training.predictor.named_parameters() if p.grad is not None}
    return found


def worker(rank, pairs, folder):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=RANKS)
    for batch in BATCHES:
        np.savez(f"{folder}/{batch}-{rank}.npz", **learn(pairs, rank, RANKS, batch))
    dist.destroy_process_group()


def test_the_first_process_alone_speaks(monkeypatch, capsys):
    """The others know neither the speed nor the files: they said 'nan pairs/s' of a run that went well."""
    for rank in ("0", "1"):
        monkeypatch.setenv("RANK", rank)
        console = Console()
        console.say(f"said by {rank}")
        console.progress(3, 3, f"done by {rank}")
        console.table("", (f"table of {rank}",), [("1",)])
    shown = capsys.readouterr()
    assert "said by 0" in shown.err and "table of 0" in shown.out
    assert "by 1" not in shown.err and "of 1" not in shown.out


@pytest.fixture(scope="module")
def learned(small_artefacts, tmp_path_factory):
    """A folder with what each of two processes learned of each batch."""
    folder = tmp_path_factory.mktemp("processes")
    torch.multiprocessing.spawn(worker, (small_artefacts["pairs"], str(folder)), nprocs=RANKS)
    return folder


@pytest.mark.parametrize("batch", BATCHES)
def test_two_processes_learn_like_one(batch, small_artefacts, learned):
    """Both work on the crop of a batch of one: all numbers are then those of one process.

    They share larger batches. Each normalises by its own half on the CPU, and the network is another by a little.
    """
    first, second = (dict(np.load(learned / f"{batch}-{rank}.npz")) for rank in range(RANKS))
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)
    alone = learn(small_artefacts["pairs"], 0, 1, batch)
    for name in ("loss", "validation"):
        assert first[name] == pytest.approx(alone[name], rel=1e-3 if batch == 1 else 0.3), name
    if batch == 1:
        scale = max(float(np.abs(value).max()) for name, value in alone.items() if name.startswith("net."))
        for name, value in alone.items():
            np.testing.assert_allclose(first[name], value, rtol=1e-2, atol=1e-3 * scale, err_msg=name)
