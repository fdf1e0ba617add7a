"""Inference on the CPU: the bare network in the best form found, ours on a window, and `lunargr infer` from scene to GeoTIFF.

The bare network is the paper's U-Net with BatchNorm folded into the convolutions, upsampling before the convolution, channels
last, in bfloat16 where that is faster, eager and compiled, on one tile without any context: nothing is read or written.
All take turns, so that a machine which others use slows them alike; rates are medians over the rounds, by the clock and by
the processor's own time. `lunargr infer` counts from the start of Python to the finished files.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio
import torch
from rasterio.transform import Affine
from torch import Tensor, nn
from torch.nn import functional

from schemas import CHECKPOINT, ArtefactWriter
from stages.common.memory import keep_freed_memory
from stages.infer.terrain import TerrainReader
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.mapper import Mapper
from stages.network.predictor import Predictor, write_state
from stages.network.unet import DROPOUT, WIDTHS, UNet
from stages.physics.photometry import get_model

TILE, SIZE, ROUNDS = 1024, int(os.environ.get("SIZE", "8192")), int(os.environ.get("ROUNDS", "3"))


class BareUNet(nn.Module):
    """Convolutions and LeakyReLU only."""

    def __init__(self, outputs: int) -> None:
        super().__init__()

        def pair(inputs: int, width: int) -> nn.ModuleList:
            return nn.ModuleList([nn.Conv2d(inputs, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1)])

        levels = range(len(WIDTHS) - 1)
        self.down = nn.ModuleList(pair(([1, *WIDTHS])[k], WIDTHS[k]) for k in range(len(WIDTHS)))
        self.rise = nn.ModuleList(
            nn.ConvTranspose2d(WIDTHS[k + 1], WIDTHS[k], 4, stride=2, padding=1) for k in reversed(levels)
        )
        self.up = nn.ModuleList(pair(2 * WIDTHS[k], WIDTHS[k]) for k in reversed(levels))
        self.head = nn.Conv2d(WIDTHS[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        kept = []
        for k, (first, second) in enumerate(self.down):  # type: ignore[misc]
            x = functional.leaky_relu(second(functional.leaky_relu(first(x), 0.01)), 0.01)
            if k < len(self.down) - 1:
                kept.append(x)
                x = functional.max_pool2d(x, 2)
        for rise, (first, second) in zip(self.rise, self.up, strict=True):  # type: ignore[misc]
            x = torch.cat([rise(x), kept.pop()], dim=1)
            x = functional.leaky_relu(second(functional.leaky_relu(first(x), 0.01)), 0.01)
        return self.head(x)


def write_inputs(folder: Path) -> tuple[Path, Path]:
    """A rough DEM of SIZE x SIZE pixels, and a checkpoint whose maps vary."""
    rng = np.random.default_rng(0)
    spectrum = np.hypot(*np.meshgrid(np.fft.fftfreq(SIZE), np.fft.rfftfreq(SIZE), indexing="ij"))
    spectrum[0, 0] = 1
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(SIZE, SIZE))) / spectrum**1.8, (SIZE, SIZE))
    dem, checkpoint = folder / "dem.tif", folder / "checkpoint.h5"
    profile = {
        "driver": "GTiff", "height": SIZE, "width": SIZE, "count": 1, "dtype": "float32", "tiled": True, "nodata": -9999.0,
        "crs": "+proj=eqc +R=1737400 +units=m", "transform": Affine(5, 0, 0, 0, -5, 0),
    }  # fmt: skip
    with rasterio.open(dem, "w", **profile) as out:
        out.write((150 * z / z.std()).astype(np.float32), 1)
    torch.manual_seed(0)
    predictor = Predictor(UNet(3), CoefficientMaps(get_model("M2"), (), torch.tensor([0.06, 0.02, 0.01]), 0.03), 10.0)
    nn.init.normal_(predictor.net.head.weight, 0, 0.1)
    attributes = {
        "model": "M2", "coefficients": '["a", "b", "c"]', "elevation_scale_m": 10.0, "output_scale": 0.03, "gsd_m": 5.0,
        "body_radius_m": 1737400.0, "maps": '["a", "b", "c"]', "globals": "{}", "positive": np.int32(0), "deviations": np.int32(0), "image_units": "iof", "best_epoch": np.int32(1), "start": "{}", "precision": "fp32",
    }  # fmt: skip
    config = {"widths": WIDTHS, "dropout": DROPOUT}
    with ArtefactWriter(
        checkpoint, CHECKPOINT, {"epoch": 1, "frame": 1}, config=config, attributes=attributes
    ) as writer:
        for name in ("train_loss", "validation_loss", "epoch_seconds", "gain", "offset"):
            writer.write(name, np.ones(1))
        writer.write("image_id", ["A"])
        write_state(writer.file.create_group("weights", track_order=True), predictor.state_dict())
    return dem, checkpoint


def bare(bf16: bool, compiled: bool) -> Callable[[], None]:
    net = BareUNet(3).eval().to(memory_format=torch.channels_last)
    x = torch.randn(1, 1, TILE, TILE).contiguous(memory_format=torch.channels_last)
    if bf16:
        net, x = net.bfloat16(), x.bfloat16()
    run = torch.compile(net) if compiled else net

    def work() -> None:
        with torch.no_grad():
            run(x)

    return work


def ours(bf16: bool, context: int) -> Callable[[], None]:
    """One tile of a map: at the map's edges, where nothing lies around it, or with the context that makes windows seamless."""
    predictor = Predictor(
        UNet(3), CoefficientMaps(get_model("M2"), (), torch.tensor([0.06, 0.02, 0.01]), 0.03), 10.0
    ).eval()
    mapper = Mapper(predictor, torch.device("cpu"), "bf16" if bf16 else "fp32")
    edge = TILE + 2 * context
    terrain = TerrainReader(torch.randn(edge, edge).numpy(), np.ones((edge, edge), np.uint8))

    def work() -> None:
        for _ in mapper.strips(terrain, (edge, edge), (context, context, TILE, TILE)):
            pass

    return work


class Rates:
    """Mpx/s by the clock and by the processor's time, of jobs that take turns."""

    def __init__(self) -> None:
        self.found: dict[str, list[tuple[float, float]]] = {}

    def time(self, name: str, job: Callable[[], None], mpx: float) -> None:
        clock, cpu = time.perf_counter(), self._cpu()
        job()
        self.found.setdefault(name, []).append((mpx / (time.perf_counter() - clock), mpx / (self._cpu() - cpu)))

    @staticmethod
    def _cpu() -> float:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(u.ru_utime + u.ru_stime for u in used)

    def median(self, name: str) -> tuple[float, float]:
        by_clock, by_cpu = zip(*self.found[name], strict=True)
        return statistics.median(by_clock), statistics.median(by_cpu)

    def show(self, name: str, fastest: str) -> None:
        (clock, cpu), (best, best_cpu) = self.median(name), self.median(fastest)
        print(
            f"{name:30s} {clock:6.2f} Mpx/s, {clock / best:5.2f} of '{fastest}'; of processor time {cpu / best_cpu:5.2f}"
        )


def main() -> None:
    keep_freed_memory()
    tile = TILE**2 / 1e6
    jobs = {f"bare, {n}, eager": bare(n == "bf16", False) for n in ("fp32", "bf16")}
    jobs["bare, bf16, compiled"] = bare(True, True)
    for name in ("fp32", "bf16"):
        jobs |= {f"ours, {name}": ours(name == "bf16", 0), f"ours, {name}, with context": ours(name == "bf16", 128)}
    for name, job in list(jobs.items()):
        try:
            job()
        except Exception as error:  # no compiler on this machine
            print(f"{name}: not possible here ({type(error).__name__})")
            del jobs[name]
    rates = Rates()
    for _ in range(ROUNDS):
        for name, job in jobs.items():
            rates.time(name, job, tile)
    fastest = max((name for name in jobs if name.startswith("bare")), key=lambda name: rates.median(name)[1])
    print(
        f"{torch.get_num_threads()} threads; load {os.getloadavg()[0]:.1f}; tiles of {TILE} x {TILE}, {ROUNDS} rounds"
    )
    for name in jobs:
        rates.show(name, fastest)
    with tempfile.TemporaryDirectory() as folder:
        dem, checkpoint = write_inputs(Path(folder))
        command = [sys.executable, "-m", "lunargr_cli.main"]
        scene, out = str(Path(folder) / "scene.h5"), str(Path(folder) / "map.h5")
        subprocess.run([*command, "ingest", str(dem), "-o", scene, "--quiet"], check=True)
        whole = Rates()
        infer = {
            f"`lunargr infer` of {Path(source).suffix}": [*command, "infer", source, str(checkpoint), "-o", out, "--overwrite", "--quiet"]
            for source in (scene, str(dem))
        }  # fmt: skip
        infer["... without the GeoTIFF"] = [*infer["`lunargr infer` of .h5"], "--no-geotiff"]
        for _ in range(ROUNDS):
            for name, line in infer.items():
                for _ in range(4):
                    whole.time(fastest, jobs[fastest], tile)
                whole.time(name, lambda line=line: subprocess.run(line, check=True), SIZE**2 / 1e6)  # type: ignore[misc]
        print(f"{SIZE} x {SIZE}; load {os.getloadavg()[0]:.1f}")
        for name in (fastest, *infer):
            whole.show(name, fastest)


if __name__ == "__main__":
    main()
