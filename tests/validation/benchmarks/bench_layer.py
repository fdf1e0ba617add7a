"""The rendering layer in training: its share of the network's step, and Mitsuba's time for the forward half alone.

    python tests/validation/benchmarks/bench_layer.py

Layer: `formation.form` and the loss on valid pixels: slopes, angles, penumbra and reflectance from scratch, forward and
backward to the coefficients, which come channels last as the network gives them. Layer and network take turns, and the
medians of their processor times are compared: other work on the machine then disturbs the ratio least.
Peer: one orthographic Mitsuba rendering (scalar_rgb, direct light, 16 samples a pixel) of the same crop, its mesh built
beforehand; a differentiable rendering costs it several times that.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

from stages.common.memory import keep_freed_memory
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.losses import squared_error
from stages.network.precision import choose_precision
from stages.network.predictor import Predictor
from stages.network.unet import UNet
from stages.physics.formation.chain import Observation, form
from stages.physics.photometry import get_model

BATCH, SIZE, GSD, ROUNDS = 64, 128, 5.0, 9
OTHERS = ("M5", "M6", "lunar_lambert", "hapke")


def cpu_seconds(function: Callable[[], object]) -> float:
    """Processor time of one call over all threads, s."""
    began = time.process_time()
    function()
    return time.process_time() - began


def mitsuba_seconds(elevation: np.ndarray, sun: np.ndarray) -> float:
    """Seconds for one forward rendering of one crop."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    n = elevation.shape[0]
    col, row = np.meshgrid(np.arange(n), np.arange(n))
    vertices = np.stack([col, n - 1 - row, elevation / GSD], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (row * n + col)[:-1, :-1].ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)]).astype(np.uint32)
    mesh = mi.Mesh("terrain", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), faces.ravel()
    parameters.update()
    look = mi.ScalarTransform4f().look_at(
        [n / 2, n / 2, 500], [n / 2, n / 2, 0], [0, 1, 0]
    ) @ mi.ScalarTransform4f().scale([n / 2, n / 2, 1])
    scene = mi.load_dict(
        {
            "type": "scene", "integrator": {"type": "direct"}, "terrain": mesh,
            "sun": {"type": "directional", "direction": (-sun).tolist()},
            "sensor": {"type": "orthographic", "to_world": look, "film": {"type": "hdrfilm", "width": n, "height": n}, "sampler": {"type": "independent", "sample_count": 16}},
        }
    )  # fmt: skip
    return min(cpu_seconds(lambda: mi.render(scene)) for _ in range(3))


def main() -> None:
    keep_freed_memory()
    rng = np.random.default_rng(0)
    z = torch.from_numpy(rng.normal(size=(BATCH, SIZE, SIZE)).cumsum(1).cumsum(2).astype(np.float32) * 0.05)
    sun = torch.tensor([[0.6, 0.2, 0.775]]).repeat(BATCH, 1)
    camera = torch.tensor([[0.0, 0.0, 8e4]]).repeat(BATCH, 1)
    observation = Observation(z, sun, camera, GSD, 1737400.0, sun_horizon=torch.full_like(z, 0.2))
    target = torch.full_like(z, 0.05)
    model = get_model("M2")
    predictor = Predictor(UNet(3), CoefficientMaps(model, (), torch.tensor([0.06, 0.02, 0.01]), 0.03), 30.0).train()
    predictor.to(memory_format=torch.channels_last)
    precision = choose_precision(torch.device("cpu"))
    valid = torch.ones(z.shape, dtype=torch.bool)

    def layer_of(name: str) -> Callable[[], None]:
        reflectance = get_model(name)
        values = torch.tensor([p.default for p in reflectance.parameters]).view(1, -1, 1, 1)
        maps = values.expand(BATCH, -1, SIZE, SIZE).contiguous(memory_format=torch.channels_last).requires_grad_()

        def layer() -> None:
            error = squared_error(form(observation, reflectance, maps), target, valid)
            torch.autograd.grad(error, maps)

        return layer

    def network() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            out = predictor(z)
        out.float().square().mean().backward()

    layer = layer_of(model.name)
    layer()  # compiles
    network()
    rounds = [(cpu_seconds(layer), cpu_seconds(network)) for _ in range(ROUNDS)]
    mine, step = (statistics.median(times) for times in zip(*rounds, strict=True))
    peer = mitsuba_seconds(z[0].numpy(), sun[0].numpy())
    print(f"rendering layer, forward + backward : {mine / BATCH * 1e3:8.3f} ms a crop of {SIZE} x {SIZE}")
    print(
        f"network, forward + backward ({precision})  : {step / BATCH * 1e3:8.3f} ms a crop; the layer is {100 * mine / step:.2f} % of it"
    )
    print(f"Mitsuba, forward only, 16 spp       : {peer * 1e3:8.3f} ms a crop; {peer / (mine / BATCH):.0f} x the layer")
    for name in OTHERS:
        other = layer_of(name)
        seconds = statistics.median(cpu_seconds(other) for _ in range(ROUNDS))
        print(f"the layer with {name:21s}: {seconds / BATCH * 1e3:8.3f} ms a crop")


if __name__ == "__main__":
    main()
