"""Training on the CPU, interleaved in one run: the best plain recipe, our network, the whole step, the loop and the loader.

The peer is the U-Net of the paper as one writes it in PyTorch (zero padding, torch's own BatchNorm, LeakyReLU, Dropout, nearest
upsampling), channels last, Adam, with bfloat16 and without: `make bench ONLY=training` runs it.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from schemas import PAIRS, ArtefactWriter
from schemas.packing import Packing, pack
from stages import train
from stages.common.memory import keep_freed_memory
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.losses import squared_error
from stages.network.predictor import Predictor
from stages.network.unet import DROPOUT, WIDTHS, UNet
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form
from stages.physics.horizon import horizon as trace
from stages.physics.photometry import get_model
from stages.project.writing import DEGREES, IMAGE

BATCH, SIZE, PAIRS_WRITTEN, ROUNDS = 64, 128, 2048, 3


class PlainUNet(nn.Module):
    """The paper's network, from its description and nothing else."""

    def __init__(self, outputs: int) -> None:
        super().__init__()

        def block(inputs: int, width: int, dropout: float) -> nn.Sequential:
            layers: list[nn.Module] = []
            for source in (inputs, width):
                layers += [
                    nn.Conv2d(source, width, 3, padding=1),
                    nn.BatchNorm2d(width),
                    nn.LeakyReLU(0.01, inplace=True),
                ]
            return nn.Sequential(*layers[:3], nn.Dropout(dropout), *layers[3:])

        levels = range(len(WIDTHS) - 1)
        self.down = nn.ModuleList(block(([1, *WIDTHS])[k], WIDTHS[k], DROPOUT[k]) for k in range(len(WIDTHS)))
        self.rise = nn.ModuleList(nn.Conv2d(WIDTHS[k + 1], WIDTHS[k], 3, padding=1) for k in reversed(levels))
        self.up = nn.ModuleList(block(2 * WIDTHS[k], WIDTHS[k], DROPOUT[k]) for k in reversed(levels))
        self.head = nn.Conv2d(WIDTHS[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        kept = []
        for block in self.down[:-1]:
            kept.append(block(x))
            x = functional.max_pool2d(kept[-1], 2)
        x = self.down[-1](x)
        for rise, block in zip(self.rise, self.up, strict=True):
            x = rise(functional.interpolate(x, scale_factor=2.0, mode="nearest"))
            x = block(torch.cat([x, kept.pop()], dim=1))
        return self.head(x)


def write_pairs(folder: Path) -> tuple[Path, Path]:
    """The same pairs as `project` lays them out, and as plain float32 chunks."""
    rng = np.random.default_rng(1)
    spectrum = np.hypot(*np.meshgrid(np.fft.fftfreq(SIZE), np.fft.rfftfreq(SIZE), indexing="ij"))
    spectrum[0, 0] = 1
    noise = np.fft.rfft2(rng.normal(size=(64, SIZE, SIZE))) / spectrum**1.8
    z = np.fft.irfft2(noise, (SIZE, SIZE))
    z *= 7 / z.std(axis=(1, 2), keepdims=True)  # about 40 m of relief
    slope = np.gradient(z, 5.0, axis=2)
    image = np.clip(0.08 * (0.7 - 0.7 * slope), 0, None) + rng.normal(0, 3e-4, z.shape)
    horizon = np.degrees([trace(layer.astype(np.float32), 5.0, math.pi / 2) for layer in z])
    packings = (Packing.over(z.min(), z.max()), IMAGE, DEGREES)
    fields = dict(
        zip(("elevation", "image", "sun_horizon_deg"), zip((z, image, horizon), packings, strict=True), strict=True)
    )
    ours, plain = folder / "pairs.h5", folder / "plain.h5"
    sizes = {"pair": PAIRS_WRITTEN, "y": SIZE, "x": SIZE, "enu": 3, "frame": 1}
    place = {"gsd_m": 5.0, "body_radius_m": 1737400.0}
    with ArtefactWriter(ours, PAIRS, sizes, attributes=place) as writer, h5py.File(plain, "w") as other:
        for name, (values, packing) in fields.items():
            target = writer.dataset(name, packing=packing)
            rest = other.create_dataset(name, target.shape, "f4", chunks=(1, SIZE, SIZE))
            for k in range(PAIRS_WRITTEN):
                rest[k] = values[k % len(values)]
                target[k] = pack(target, values[k % len(values)])
        valid = writer.dataset("valid")
        other.create_dataset("valid", valid.shape, "u1", chunks=(1, SIZE, SIZE))
        for k in range(PAIRS_WRITTEN):
            valid[k] = other["valid"][k] = 1
        writer.write("sun_direction_enu", np.tile([0.7, 0.14, 0.7], (PAIRS_WRITTEN, 1)))
        writer.write("camera_position_enu", np.tile([0.0, 0.0, 1e5], (PAIRS_WRITTEN, 1)))
        for name in ("longitude_deg", "latitude_deg", "image_index"):
            writer.write(name, np.zeros(PAIRS_WRITTEN))
        writer.write("site", np.arange(PAIRS_WRITTEN))
        writer.write("split", (np.arange(PAIRS_WRITTEN) >= 6 * BATCH).astype(int) * 2)
        writer.write("image_id", ["A"])
    return ours, plain


def peer_step(bf16: bool) -> Callable[[], None]:
    net = PlainUNet(3).train().to(memory_format=torch.channels_last)
    optimizer = torch.optim.Adam(net.parameters(), 1e-4)
    x = torch.randn(BATCH, 1, SIZE, SIZE).contiguous(memory_format=torch.channels_last)

    def step() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            out = net(x)
        optimizer.zero_grad(set_to_none=True)
        out.float().square().mean().backward()
        optimizer.step()

    return step


def our_steps(reader: PairReader, bf16: bool) -> dict[str, Callable[[], None]]:
    """The network alone with its optimiser, as the peer's; the rendering layer alone; and the step that `train` takes."""
    model = get_model("M2")
    predictor = Predictor(UNet(3), CoefficientMaps(model, (), torch.tensor([0.06, 0.02, 0.01]), 0.03), 10.0).train()
    predictor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.Adam(predictor.parameters(), 1e-4, fused=True)
    batch = reader.batch(np.arange(BATCH))
    coefficients = torch.full((BATCH, 3, SIZE, SIZE), 0.05, requires_grad=True)

    def network() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            out = predictor.net(batch.observation.elevation[:, None])
        optimizer.zero_grad(set_to_none=True)
        out.float().square().mean().backward()
        optimizer.step()

    def layer() -> None:
        squared_error(form(batch.observation, model, coefficients), batch.image, batch.valid).backward()

    def whole() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            out = predictor(batch.observation.elevation)
        error = squared_error(form(batch.observation, model, out.float()), batch.image, batch.valid)
        optimizer.zero_grad(set_to_none=True)
        (error / batch.valid.sum()).backward()
        optimizer.step()

    return {"our network": network, "rendering layer": layer, "our step": whole}


def readers(ours: Path, plain: Path, reader: PairReader) -> dict[str, Callable[[], None]]:
    rng = np.random.default_rng(0)
    names = ["elevation", "image", "valid", "sun_horizon_deg"]
    file, packed = h5py.File(plain, "r"), h5py.File(ours, "r")
    datasets, packed_datasets = [file[n] for n in names], [packed[n] for n in names]
    count = 8 * BATCH

    def loader() -> None:
        order = rng.permutation(PAIRS_WRITTEN)[:count]
        for first in range(0, count, BATCH):
            reader.batch(order[first : first + BATCH])

    def h5py_plain() -> None:
        for k in rng.permutation(PAIRS_WRITTEN)[:count]:
            for data in datasets:
                data[k]

    def h5py_packed() -> None:
        for k in rng.permutation(PAIRS_WRITTEN)[:count]:
            for data in packed_datasets:
                data[k]

    return {"our loader, batches": loader, "h5py, plain float32": h5py_plain, "h5py, our file": h5py_packed}


def least(jobs: dict[str, Callable[[], None]], rounds: int) -> dict[str, float]:
    best = dict.fromkeys(jobs, float("inf"))
    for job in jobs.values():
        job()
    for _ in range(rounds):
        for name, job in jobs.items():
            began = time.perf_counter()
            job()
            best[name] = min(best[name], time.perf_counter() - began)
    return best


def main() -> None:
    keep_freed_memory()
    threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder:
        ours, plain = write_pairs(Path(folder))
        print(f"{threads} threads; load {os.getloadavg()[0]:.1f}; crops of {SIZE} x {SIZE}, batches of {BATCH}")
        sizes = [os.path.getsize(p) / PAIRS_WRITTEN / 1024 for p in (ours, plain)]
        print(f"on disk: {sizes[0]:.1f} KiB a pair, plain float32 {sizes[1]:.1f}")
        with PairReader(ours) as reader:
            jobs = readers(ours, plain, reader)
            best = least(jobs, ROUNDS)
            for name, seconds in best.items():
                print(f"{name:28s} {8 * BATCH / seconds:9.0f} pairs/s (all four variables)")
            steps = {f"peer, {n}": peer_step(n == "bf16") for n in ("fp32", "bf16")}
            for name in ("fp32", "bf16"):
                steps |= {f"{k}, {name}": v for k, v in our_steps(reader, name == "bf16").items()}
            best = least(steps, ROUNDS)
        peer = min(best["peer, fp32"], best["peer, bf16"])
        for name, seconds in best.items():
            print(f"{name:28s} {BATCH / seconds:9.1f} samples/s, {peer / seconds:5.2f} of the best peer")
        step = min(best["our step, fp32"], best["our step, bf16"])
        print(f"the rendering layer is {100 * best['rendering layer, bf16'] / step:.1f} % of our step")
        config = train.Config(model="M2", epochs=2, batch=BATCH, device="cpu")
        found = train.run(ours, Path(folder) / "checkpoint.h5", config)
        print(f"`lunargr train`, whole epochs {found.pairs_per_second:9.1f} pairs/s in {found.precision}")


if __name__ == "__main__":
    main()
