"""train: a U-Net that predicts reflectance from terrain, learned through the differentiable formation chain.

Read from top to bottom: set up, one loop over epochs, one loop over batches. Several processes (``torchrun``) share every
batch; the first one writes.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor

from schemas import CHECKPOINT, ArtefactWriter, ConfigError, InputError, check_output
from schemas.provenance import sha256
from stages.common.memory import keep_freed_memory
from stages.network.losses import Radiometry, masked_mse, squared_error
from stages.network.predictor import Predictor, choose_device, write_state
from stages.network.processes import join_group, mean_over_ranks, same_everywhere, sum_gradients, sum_over_ranks
from stages.network.resume import History, restore, save, snapshot
from stages.network.runtime import choose_precision
from stages.network.unet import DROPOUT, WIDTHS, UNet
from stages.network.uniform import elevation_scale, fit_start
from stages.pairs import symmetries
from stages.pairs.reader import Batch, PairReader
from stages.physics.formation.chain import Extension, form
from stages.physics.photometry import get_model

CHECK_EVERY = 16  # batches: looking at the loss makes a GPU wait

Say = Callable[[str], None]
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Config:
    """Defaults are the paper's: Adam, 1e-4, batches of 64, 20 epochs. ``schedule``: 'constant' or 'cosine'."""

    model: str = "M2"
    epochs: int = 20
    batch: int = 64
    lr: float = 1e-4
    schedule: str = "constant"
    widths: tuple[int, ...] = WIDTHS
    dropout: tuple[float, ...] = DROPOUT
    augment: bool = True
    seed: int = 0
    device: str = "auto"
    precision: str = "auto"
    extend: str | None = None


@dataclass(frozen=True)
class Summary:
    """What training reached."""

    history: History
    pairs_per_second: float
    precision: str
    start: dict[str, float]


def run(
    pairs: Path,
    output: Path,
    config: Config,
    overwrite: bool = False,
    resume: bool = False,
    say: Say = lambda line: None,
    progress: Progress | None = None,
) -> Summary:
    """Write ``checkpoint.h5``: the weights of the best validation epoch. Raises ConfigError, InputError, ArtefactError.

    After every epoch the whole state goes to a file beside the output, from which ``resume`` goes on to the same result.
    """
    _check(config)
    check_output(output, [pairs], overwrite)
    rank, ranks = join_group()
    device = choose_device(config.device)
    if device.type == "cuda" and ranks > 1:
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
    keep_freed_memory()
    extensions = _load_extensions(config.extend)
    if (
        extensions and config.augment
    ):  # an effect may belong to a direction on the ground, which turning crops would lose
        say("crops are not turned or mirrored: the extended model may hold effects bound to an azimuth")
        config = replace(config, augment=False)
    with PairReader(pairs, detector=bool(extensions)) as reader:
        train, validation = reader.indices("train"), reader.indices("validation")
        if not len(train):
            raise InputError(
                f"{pairs}:/split: expected training pairs (split = 0), found none; sample more crops or other tiles."
            )
        stride = 2 ** (len(config.widths) - 1)
        if any(s % stride for s in reader.size):
            raise ConfigError(
                f"{pairs}: expected crops of a multiple of {stride} px for {len(config.widths)} widths, found {reader.size[0]} x {reader.size[1]}."
            )

        torch.manual_seed(config.seed)
        model = get_model(config.model)
        start, radiometry = fit_start(reader, train, model)
        raw_start = model.unconstrain(start[None], dim=1)[0]
        output_scale = float(start.abs().mean()) if model.linear else 0.3
        scale = elevation_scale(reader, train)
        predictor = Predictor(model, UNet(len(start), config.widths, config.dropout), scale, raw_start, output_scale)
        predictor.gsd, predictor.image_units = reader.gsd, reader.units
        predictor.to(device)
        predictor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        radiometry.to(device)
        parameters = [p for p in (*predictor.parameters(), *radiometry.parameters()) if p.requires_grad]
        optimizer = torch.optim.Adam(parameters, lr=config.lr, fused=True)
        history = History()
        best: dict[str, Tensor] = {}

        sidecar = output.with_name(f"{output.stem}.resume.h5")
        identity = json.dumps(
            asdict(config) | {"device": None, "epochs": None, "pairs": sha256(pairs), "ranks": ranks}, sort_keys=True
        )
        precision = config.precision
        if resume and sidecar.exists():
            precision = restore(sidecar, identity, predictor, radiometry, optimizer, history, best, device)
            say(f"resumed after epoch {len(history.train_loss)}/{config.epochs}")
        elif precision == "auto":
            precision = choose_precision(predictor, reader.size, device) if rank == 0 else "fp32"
            precision = same_everywhere(precision, ranks)
        if rank == 0:
            say(
                f"model {model.name}, {sum(p.numel() for p in predictor.net.parameters()):,} weights, {len(train)} training and "
                f"{len(validation)} validation pairs, {device}, {precision}"
                + (f", {ranks} processes" if ranks > 1 else "")
            )

        speed = math.nan
        for epoch in range(len(history.train_loss), config.epochs):
            began = time.monotonic()
            # All randomness of an epoch hangs on (seed, epoch): a resumed run draws what an uninterrupted one would.
            rng = np.random.default_rng([config.seed, epoch])
            torch.manual_seed(hash((config.seed, epoch)) % 2**31)
            for group in optimizer.param_groups:
                group["lr"] = _learning_rate(config, epoch)
            predictor.train()
            sums = torch.zeros(2, dtype=torch.float64, device=device)  # squared errors and pixels of this process
            steps, keys = _steps(train, config, rng, rank, ranks)
            for number, batch in enumerate(_prefetch(reader, steps, device)):
                measured = batch.image / radiometry.scale
                with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
                    coefficients = predictor(batch.observation.elevation, keys[number].to(device))
                rendered = form(batch.observation, model, coefficients.float(), extensions)
                error = squared_error(radiometry(rendered, batch.observation.frame), measured, batch.valid)
                pixels = batch.valid.sum().double()
                sums += torch.stack([error.detach().double(), pixels])
                if number % CHECK_EVERY == 0 and not torch.isfinite(sums[0]):
                    break
                # The mean over the valid pixels of the whole batch; this process has its share of the sum.
                loss = error / sum_over_ranks(pixels, ranks).clamp(min=1).float()
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                if ranks > 1:
                    sum_gradients(parameters)
                optimizer.step()
                if progress and rank == 0:
                    progress(number + 1, len(steps), f"epoch {epoch + 1}/{config.epochs}")
            error_sum, pixel_sum = sums.tolist()
            if not math.isfinite(error_sum):
                raise InputError(
                    f"{pairs}: the loss is not finite in epoch {epoch + 1}; lower --lr or check the images' units."
                )
            training_seconds = time.monotonic() - began
            train_loss = mean_over_ranks(error_sum, pixel_sum, ranks, device)
            validation_loss = evaluate_loss(
                reader, validation, predictor, radiometry, extensions, config.batch, device, rank, ranks
            )
            history.train_loss.append(train_loss)
            history.validation_loss.append(validation_loss)
            history.epoch_seconds.append(time.monotonic() - began)
            criterion = validation_loss if math.isfinite(validation_loss) else train_loss
            earlier = [
                v if math.isfinite(v) else t
                for v, t in zip(history.validation_loss[:-1], history.train_loss[:-1], strict=True)
            ]
            if criterion <= min(earlier, default=math.inf):
                history.best_epoch = epoch
                best = snapshot(predictor, radiometry)
            if rank == 0:
                save(sidecar, identity, predictor, radiometry, optimizer, history, best, precision)
                speed = len(train) / training_seconds
                left = (config.epochs - epoch - 1) * history.epoch_seconds[-1]
                say(
                    f"epoch {epoch + 1:3d}/{config.epochs}  train {train_loss:.4e}  validation {validation_loss:.4e}"
                    f"{' *' if history.best_epoch == epoch else '  '} {speed:6.1f} pairs/s  {left / 60:5.1f} min left"
                )
        if rank == 0:
            _write_checkpoint(
                pairs, output, config, predictor, best, history, reader, precision, start, scale, overwrite
            )
            sidecar.unlink(missing_ok=True)
    if ranks > 1:
        dist.barrier()
        dist.destroy_process_group()
    names = [p.name for p in model.parameters]
    return Summary(history, speed, precision, dict(zip(names, start.tolist(), strict=True)))


@torch.no_grad()
def evaluate_loss(
    reader: PairReader,
    indices: NDArray[np.int64],
    predictor: Predictor,
    radiometry: Radiometry,
    extensions: Sequence[Extension],
    batch_size: int,
    device: torch.device,
    rank: int = 0,
    ranks: int = 1,
) -> float:
    """Mean squared error over the valid pixels of some pairs, in evaluation mode; NaN where there are none."""
    predictor.eval()
    total, pixels = 0.0, 0.0
    mine = indices[rank::ranks]
    steps = [(mine[k : k + batch_size], None) for k in range(0, len(mine), batch_size)]
    for batch in _prefetch(reader, steps, device):
        rendered = form(batch.observation, predictor.model, predictor(batch.observation.elevation), extensions)
        count = float(batch.valid.sum())
        loss = masked_mse(radiometry(rendered, batch.observation.frame), batch.image / radiometry.scale, batch.valid)
        total, pixels = total + loss.item() * count, pixels + count
    return mean_over_ranks(total, pixels, ranks, device)


def _check(config: Config) -> None:
    if config.epochs < 1 or config.batch < 1:
        raise ConfigError(f"--epochs and --batch: expected at least 1, found {config.epochs} and {config.batch}.")
    if not (math.isfinite(config.lr) and 0 < config.lr < 1):
        raise ConfigError(f"--lr: expected a number between 0 and 1, found {config.lr}.")
    if config.schedule not in ("constant", "cosine"):
        raise ConfigError(f"--schedule: expected 'constant' or 'cosine', found '{config.schedule}'.")
    if config.precision not in ("auto", "fp32", "bf16"):
        raise ConfigError(f"--precision: expected auto, fp32 or bf16, found '{config.precision}'.")
    if len(config.widths) < 2 or min(config.widths) < 1:
        raise ConfigError(f"--widths: expected at least two positive widths, found {config.widths}.")
    get_model(config.model)


def _load_extensions(path: str | None) -> list[Extension]:
    if path is None:
        return []
    from stages.effects import load_extension

    return list(load_extension(Path(path)))


def _learning_rate(config: Config, epoch: int) -> float:
    if config.schedule == "constant":
        return config.lr
    return config.lr * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * epoch / config.epochs)))


def _steps(
    train: NDArray[np.int64], config: Config, rng: np.random.Generator, rank: int, ranks: int
) -> tuple[list[tuple[NDArray, NDArray | None]], list[Tensor]]:
    """The batches of one epoch for this process: (pair indices, symmetries), and the crops' keys for dropout.

    Every process gets as many batches; what a crop meets does not depend on the process that works on it.
    """
    order = rng.permutation(train)
    turns = rng.integers(0, symmetries.COUNT, len(order)) if config.augment else None
    count = math.ceil(len(order) / config.batch)
    bounds = [len(order) * k // count for k in range(count + 1)]  # equal batches: BatchNorm dislikes a rest of one
    drawn = torch.from_numpy(rng.integers(0, 2**62, len(order)))
    steps, keys = [], []
    for first, last in itertools.pairwise(bounds):
        mine = np.arange(first, last)[rank::ranks] if last - first >= ranks else np.arange(first, last)
        steps.append((order[mine], None if turns is None else turns[mine]))
        keys.append(drawn[mine])
    return steps, keys


def _prefetch(reader: PairReader, steps: Sequence[tuple[NDArray, NDArray | None]], device: torch.device):
    """Batches in order, the next one read while the current one is worked on."""
    with ThreadPoolExecutor(1) as pool:
        waiting = None
        for indices, turns in steps:
            following = pool.submit(reader.batch, indices, turns)
            if waiting is not None:
                yield _arrive(waiting.result(), device)
            waiting = following
        if waiting is not None:
            yield _arrive(waiting.result(), device)


def _arrive(batch: Batch, device: torch.device) -> Batch:
    return batch if device.type == "cpu" else batch.to(device)


def _write_checkpoint(
    pairs: Path,
    output: Path,
    config: Config,
    predictor: Predictor,
    best: dict[str, Tensor],
    history: History,
    reader: PairReader,
    precision: str,
    start: Tensor,
    scale: float,
    overwrite: bool,
) -> None:
    radiometry = Radiometry(
        torch.ones(len(reader.image_ids)), torch.zeros(len(reader.image_ids)), reader.units == "iof"
    )
    radiometry.load_state_dict({k.split("/", 1)[1]: v.cpu() for k, v in best.items() if k.startswith("radiometry/")})
    trained = set(reader.frame[reader.indices("train")].tolist())
    known = np.array([k in trained or reader.units == "iof" for k in range(len(reader.image_ids))])
    names = [p.name for p in predictor.model.parameters]
    attributes = {
        "model": predictor.model.name,
        "coefficients": json.dumps(names),
        "elevation_scale_m": scale,
        "output_scale": predictor.output_scale,
        "gsd_m": reader.gsd,
        "body_radius_m": reader.body_radius,
        "image_units": reader.units,
        "best_epoch": np.int32(history.best_epoch),
        "start": json.dumps(dict(zip(names, start.tolist(), strict=True))),
        "precision": precision,
    }
    sizes = {"epoch": len(history.train_loss), "frame": len(reader.image_ids)}
    with ArtefactWriter(
        output,
        CHECKPOINT,
        sizes,
        config=asdict(config),
        inputs=[pairs],
        seed=config.seed,
        attributes=attributes,
        overwrite=overwrite,
    ) as writer:
        for key in ("train_loss", "validation_loss", "epoch_seconds"):
            writer.write(key, np.array(getattr(history, key)))
        writer.write("image_id", reader.image_ids)
        # An image without training pairs has no gain of its own: NaN says so.
        writer.write("gain", np.where(known, radiometry.gain().detach().numpy(), np.nan))
        writer.write("offset", np.where(known, radiometry.offset().detach().numpy(), np.nan))
        state = {k.split("/", 1)[1]: v for k, v in best.items() if k.startswith("predictor/")}
        write_state(writer.file.create_group("weights", track_order=True), state)
