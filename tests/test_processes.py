"""Several processes are one: batch statistics, dropout and gradients do not depend on how a batch is shared out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.distributed as dist
from torch import nn

from stages.network.layers import Dropout, dropout_threshold, kept_values, layer_keys
from stages.network.unet import UNet
from stages.train.processes import sum_gradients

SHARES = (5, 2)  # crops of each process: unequal, as the last of a batch may be


def step(net, x, keys):
    """One loss that weighs every crop and pixel; gradients stay in the parameters."""
    out = net(x, keys)
    weight = torch.linspace(0.5, 2, out.shape[-1])
    (out * out * weight).sum().backward()
    return out.detach()


def setting():
    torch.manual_seed(3)
    net = UNet(2, widths=(6, 8, 12), dropout=(0.2, 0.1, 0.3)).train()
    nn.init.normal_(net.head.weight)
    x = torch.randn(sum(SHARES), 1, 32, 32) * torch.linspace(0.3, 3, sum(SHARES))[:, None, None, None]
    return net, x, torch.arange(sum(SHARES)) * 7919


def worker(rank, folder):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=len(SHARES))
    net, x, keys = setting()
    first = sum(SHARES[:rank])
    mine = slice(first, first + SHARES[rank])
    out = step(net, x[mine], keys[mine])
    sum_gradients(list(net.parameters()))
    gradients = {name: p.grad.numpy() for name, p in net.named_parameters()}
    np.savez(f"{folder}/{rank}.npz", out=out.numpy(), **gradients, **{k: v.numpy() for k, v in net.named_buffers()})
    dist.destroy_process_group()


def test_a_batch_shared_by_two_processes_is_the_batch(tmp_path):
    """Outputs, every gradient and BatchNorm's running statistics; alone, normalisation is torch's own."""
    torch.multiprocessing.spawn(worker, (str(tmp_path),), nprocs=len(SHARES))
    net, x, keys = setting()
    out = step(net, x, keys)
    found = [dict(np.load(tmp_path / f"{rank}.npz")) for rank in range(len(SHARES))]
    np.testing.assert_allclose(np.concatenate([f["out"] for f in found]), out.numpy(), rtol=1e-3, atol=1e-4)
    scale = max(float(p.grad.abs().max()) for p in net.parameters() if p.grad is not None)
    for part in found:
        for name, p in net.named_parameters():
            if p.grad is None:  # a bias before a normalisation
                continue
            np.testing.assert_allclose(part[name], p.grad.numpy(), rtol=1e-3, atol=1e-5 * scale, err_msg=name)
        for name, buffer in net.named_buffers():
            np.testing.assert_allclose(part[name], buffer.numpy(), rtol=1e-4, atol=1e-6, err_msg=name)


def test_dropout_hangs_on_the_crop_and_the_layer_alone():
    keys = torch.tensor([5, 2**61 + 17, 5, 900])
    x = torch.ones(4, 8, 16, 16)
    drop = Dropout(0.25, 3)
    out = drop(x, keys)
    assert torch.equal(out[0], out[2]) and not torch.equal(out[0], out[1])
    assert torch.equal(drop(x[1:2], keys[1:2])[0], out[1])
    assert not torch.equal(Dropout(0.25, 4)(x, keys), out)
    assert torch.equal(drop.eval()(x, keys), x)


@pytest.mark.parametrize("p", [0.1, 0.3])
def test_dropout_drops_its_share_and_keeps_the_mean(p):
    keys = torch.arange(6) * 104729
    kept, factor = kept_values(keys, 1, p, (16, 64, 64))
    values = kept.float().numpy()
    n = values.size
    assert values.mean() == pytest.approx(1 - p, abs=4 * np.sqrt(p * (1 - p) / n) + 1e-5)
    assert dropout_threshold(p)[1] == factor == pytest.approx(1 / (1 - p), rel=1e-4)
    residual = (values - values.mean()) / values.std()
    for other in (np.roll(residual, 1, 0), np.roll(residual, 1, 1), np.roll(residual, 1, 2), np.roll(residual, 1, 3)):
        assert abs((residual * other).mean()) < 4 / np.sqrt(n)


def test_layer_keys_are_splitmix64():
    """The first outputs of splitmix64 from seed 1234567, as published with its reference code."""
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    for layer, expected in enumerate(published):
        low, high = layer_keys(torch.tensor([1234567]), layer)
        assert int(high) << 32 | int(low) == expected
