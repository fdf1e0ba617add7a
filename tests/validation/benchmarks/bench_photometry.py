"""Reflectance of a training batch, forward and backward to the coefficients: every model beside Dr.Jit and a copy.

    python tests/validation/benchmarks/bench_photometry.py

64 crops of 128 x 128 in float32, geometry given. The peer is the same M2 written for Dr.Jit, Mitsuba's compiler, which
fuses it into one kernel forward and one backward; "copy" moves the three coefficient maps once. Wall time is the least
of interleaved repetitions, CPU time the median over all threads, which other work on the machine disturbs less.
Ratios below 1 are faster than the peer.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry import get_model, masked_radiance_factor, model_names

BATCH, SIZE, REPEATS = 64, 128, 9


def peer(mu0: torch.Tensor, mu: torch.Tensor, cos_phase: torch.Tensor, weight: torch.Tensor) -> Callable[[], None]:
    """M2 with its mask, forward and backward, in Dr.Jit."""
    import drjit as dr
    from drjit.llvm.ad import Float

    geometry = [Float(t.numpy().ravel()) for t in (mu0, mu, cos_phase)]
    upstream = Float(weight.numpy().ravel())
    maps = [Float(torch.randn(mu0.numel()).numpy()) for _ in range(3)]

    def step() -> None:
        coefficients = [Float(c) for c in maps]
        dr.enable_grad(coefficients)
        i, e, g = geometry
        a, b, c = coefficients
        image = dr.select((i > 1e-7) & (e > 1e-7), a * i + b * g + c, 0)
        dr.eval(image)
        dr.backward(image * upstream)
        gradients = [dr.grad(c) for c in coefficients]
        dr.eval(gradients)
        dr.sync_thread()

    return step


def ours(
    name: str, mu0: torch.Tensor, mu: torch.Tensor, cos_phase: torch.Tensor, weight: torch.Tensor
) -> Callable[[], None]:
    model = get_model(name)
    shape = (BATCH, len(model.parameters), SIZE, SIZE)
    defaults = torch.tensor(list(model.defaults().values())).view(1, -1, 1, 1)
    coefficients = (defaults * (1 + 0.1 * torch.rand(shape))).requires_grad_()

    def step() -> None:
        image = masked_radiance_factor(model, model.unpack(coefficients, 1), Angles(mu0, mu, cos_phase))
        torch.autograd.grad(image, coefficients, weight)

    return step


def main() -> None:
    torch.manual_seed(0)
    shape = (BATCH, SIZE, SIZE)
    mu0, mu, weight = torch.rand(shape) * 0.9 + 0.1, torch.rand(shape) * 0.3 + 0.7, torch.rand(shape)
    azimuth = torch.rand(shape) * 3.14
    cos_phase = mu0 * mu + ((1 - mu0**2) * (1 - mu**2)).sqrt() * azimuth.cos()
    maps = torch.randn(BATCH, 3, SIZE, SIZE)
    steps: dict[str, Callable[[], object]] = {"copy": maps.clone, "Dr.Jit M2": peer(mu0, mu, cos_phase, weight)}
    steps |= {name: ours(name, mu0, mu, cos_phase, weight) for name in model_names()}
    wall: dict[str, list[float]] = {name: [] for name in steps}
    cpu: dict[str, list[float]] = {name: [] for name in steps}
    for repeat in range(REPEATS + 1):
        for name, step in steps.items():
            start, start_cpu = time.perf_counter(), time.process_time()
            step()
            if repeat:  # the first round compiles and faults pages in
                wall[name].append(time.perf_counter() - start)
                cpu[name].append(time.process_time() - start_cpu)
    peer_cpu = statistics.median(cpu["Dr.Jit M2"])
    print(f"{BATCH} x {SIZE} x {SIZE} float32, forward + backward, {torch.get_num_threads()} threads")
    print(f"{'model':26s}{'wall ms':>9s}{'CPU ms':>9s}{'CPU us/crop':>13s}{'CPU / Dr.Jit M2':>17s}")
    for name in steps:
        used = statistics.median(cpu[name])
        line = (
            f"{name:26s}{min(wall[name]) * 1e3:9.2f}{used * 1e3:9.2f}{used / BATCH * 1e6:13.1f}{used / peer_cpu:17.2f}"
        )
        print(line)


if __name__ == "__main__":
    main()
