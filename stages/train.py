"""train: a U-Net that predicts reflectance from terrain, learned through the differentiable formation chain.

Read from top to bottom: set up, one loop over epochs, one loop over batches. Several processes (``torchrun``) share every
batch; the first one writes.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor

from schemas import CHECKPOINT, ArtefactWriter, ConfigError, InputError
from schemas.files.outputs import Target, check_apart, check_outputs
from schemas.provenance import sha256
from stages.common.memory import keep_freed_memory
from stages.common.threads import one_thread_each
from stages.network.losses import Radiometry, crop_errors
from stages.network.maps import CoefficientMaps
from stages.network.pieces import sum_over_crops
from stages.network.predictor import Predictor, choose_device, write_state
from stages.network.processes import join_group, mean_over_ranks, sum_gradients, sum_over_ranks
from stages.network.resume import History, restore, save, snapshot
from stages.network.runtime import choose_precision
from stages.network.spread import fit_deviations
from stages.network.steps import learning_rate, order_steps, prefetch
from stages.network.stored import DEEPEST, WIDEST
from stages.network.unet import UNet
from stages.network.uniform import elevation_scale, fit_start
from stages.pairs.reader import Batch, PairReader
from stages.physics.formation.chain import Extension, form
from stages.physics.photometry import get_model

CHECK_EVERY = 16  # batches: looking at the loss makes a GPU wait

Say = Callable[[str], None]
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Config:
    """Defaults are what does best on validation ground; the paper's are named in the command's help.

    maps : coefficients predicted place by place, the others are fitted globally; empty: the model's own choice
    positive : keep coefficients nearly positive, as Lunar-G2R does; models linear in their coefficients only
    brightness : weight of each crop's overall brightness in the loss, 0..1; 1: plain squared errors. Whole crops are
        bright or dark for reasons that terrain does not show: counted in full, the network learns ground by heart
    schedule : 'constant' or 'cosine'
    """

    model: str = "hapke"
    maps: tuple[str, ...] = ()
    positive: bool = False
    epochs: int = 20
    batch: int = 32
    lr: float = 3e-3
    schedule: str = "cosine"
    widths: tuple[int, ...] = (8, 16, 32)
    dropout: tuple[float, ...] = (0.0,)
    brightness: float = 0.1
    augment: bool = True
    seed: int = 0
    device: str = "auto"
    precision: str = "auto"
    extend: str | None = None


@dataclass
class Training:
    """What every step works with and changes. rank, ranks : this process among those that share every batch."""

    reader: PairReader
    predictor: Predictor
    radiometry: Radiometry
    optimizer: torch.optim.Optimizer
    extensions: list[Extension]
    device: torch.device
    precision: str
    start: dict[str, float]
    rank: int = 0
    ranks: int = 1

    @property
    def learned(self) -> list[Tensor]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]


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
    check(config)
    sidecar = output.with_name(f"{output.stem}.resume.h5")
    inputs = [pairs, *([Path(config.extend)] if config.extend else [])]
    check_outputs([Target(output)], inputs, overwrite)
    check_apart([Target(output), Target(sidecar, what=f"the state of the unfinished {output.name}")], inputs)
    rank, ranks = join_group()
    device = choose_device(config.device)
    if device.type == "cuda" and ranks > 1:
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
    keep_freed_memory()
    extensions = _load_extensions(config.extend, pairs, say)
    if extensions and config.augment:
        # an effect may belong to a direction on the ground, which turning crops would lose
        say("crops are not turned or mirrored: the extended model may hold effects bound to an azimuth")
        config = replace(config, augment=False)
    with one_thread_each(), PairReader(pairs, detector=bool(extensions)) as reader:
        _check_pairs(pairs, reader, config, say)
        training = _set_up(reader, config, extensions, device, rank, ranks)
        history, best = History(), dict[str, Tensor]()
        # A constant rate may go on for longer; what a cosine did in its first epochs hangs on how many there are.
        epochs = config.epochs if config.schedule == "cosine" else None
        identity = json.dumps(
            asdict(config) | {"device": None, "epochs": epochs, "pairs": sha256(pairs), "ranks": ranks}, sort_keys=True
        )
        if resume and sidecar.exists():
            training.precision = restore(
                sidecar,
                identity,
                training.predictor,
                training.radiometry,
                training.optimizer,
                history,
                best,
                device,
            )
            say(f"resumed after epoch {len(history.train_loss)}/{config.epochs}")
        if rank == 0:
            say(_introduction(training))
        speed = math.nan
        train, validation = reader.indices("train"), reader.indices("validation")
        for epoch in range(len(history.train_loss), config.epochs):
            began = time.monotonic()
            train_loss = learn_epoch(training, train, config, epoch, progress)
            training_seconds = time.monotonic() - began
            validation_loss, objective = evaluate_loss(training, validation, config.batch, config.brightness)
            history.train_loss.append(train_loss)
            history.validation_loss.append(validation_loss)
            # chosen by what is minimised: the level of a few crops of validation ground would choose by chance
            history.objective.append(objective if math.isfinite(objective) else train_loss)
            history.epoch_seconds.append(time.monotonic() - began)
            if history.objective[-1] <= min(history.objective):
                history.best_epoch = epoch
                best = snapshot(training.predictor, training.radiometry)
            if rank == 0:
                predictor, radiometry, optimizer = training.predictor, training.radiometry, training.optimizer
                save(sidecar, identity, predictor, radiometry, optimizer, history, best, training.precision)
                speed = len(train) / training_seconds
                left = (config.epochs - epoch - 1) * history.epoch_seconds[-1]
                say(
                    f"epoch {epoch + 1:3d}/{config.epochs}  train {train_loss:.4e}  validation {validation_loss:.4e}"
                    f"{' *' if history.best_epoch == epoch else '  '} {speed:6.1f} pairs/s  {left / 60:5.1f} min left"
                )
        if rank == 0:
            _take(training, best)
            fit_deviations(
                training.predictor, training.radiometry, reader, train, validation, extensions=training.extensions
            )
            _write_checkpoint(output, config, training, history, overwrite)
            sidecar.unlink(missing_ok=True)
    if ranks > 1:
        dist.barrier()
        dist.destroy_process_group()
    return Summary(history, speed, training.precision, training.start)


def _set_up(
    reader: PairReader, config: Config, extensions: list[Extension], device: torch.device, rank: int, ranks: int
) -> Training:
    """The network at the best uniform surface of the training pairs, and all that goes with it."""
    torch.manual_seed(config.seed)
    model = get_model(config.model)
    train = reader.indices("train")
    start, radiometry = fit_start(reader, train, model, config.positive)
    # Linear: about the coefficients' own size, whatever their bounds are. Else: a third of a unit of the sigmoid.
    span = [1.0 if config.positive else p.upper - p.lower for p in model.parameters]
    output_scale = float((start.abs() / torch.tensor(span)).mean()) * 4 if model.linear else 0.3
    maps = CoefficientMaps(model, config.maps, start, output_scale, config.positive, deviations=True)
    net = UNet(maps.channels, config.widths, config.dropout)
    predictor = Predictor(net, maps, elevation_scale(reader, train))
    predictor.gsd, predictor.image_units = reader.gsd, reader.units
    predictor.to(device)
    predictor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    radiometry.to(device)
    learned = [p for p in (*predictor.parameters(), *radiometry.parameters()) if p.requires_grad]
    optimizer = torch.optim.Adam(learned, lr=config.lr, fused=True)
    precision = choose_precision(device) if config.precision == "auto" else config.precision
    named = dict(zip((p.name for p in model.parameters), start.tolist(), strict=True))
    return Training(reader, predictor, radiometry, optimizer, extensions, device, precision, named, rank, ranks)


def learn_epoch(
    training: Training, train: NDArray[np.int64], config: Config, epoch: int, progress: Progress | None = None
) -> float:
    """One pass over the training pairs; the mean squared error on the way. Raises InputError where it is not finite."""
    rank, ranks, device = training.rank, training.ranks, training.device
    # All randomness of an epoch hangs on (seed, epoch): a resumed run draws what an uninterrupted one would.
    rng = np.random.default_rng([config.seed, epoch])
    torch.manual_seed(hash((config.seed, epoch)) % 2**31)
    training.predictor.train()
    sums = torch.zeros(2, dtype=torch.float64, device=device)  # squared errors and pixels of this process
    steps, keys = order_steps(train, config.batch, config.augment, rng, rank, ranks)
    for number, batch in enumerate(prefetch(training.reader, steps, device)):
        for group in training.optimizer.param_groups:
            group["lr"] = learning_rate(
                config.lr, config.schedule, epoch * len(steps) + number, config.epochs * len(steps)
            )
        objective, error = _errors(training, batch, config.brightness, keys[number].to(device))
        pixels = batch.valid.sum().double()
        sums += torch.stack([error.detach().double(), pixels])
        if number % CHECK_EVERY == 0 and not torch.isfinite(sums[0]):
            break
        # The mean over the valid pixels of the whole batch; this process has its share of the sum.
        loss = objective / sum_over_ranks(pixels, ranks).clamp(min=1).float()
        training.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if ranks > 1:
            sum_gradients(training.learned)
        training.optimizer.step()
        if progress and rank == 0:
            progress(number + 1, len(steps), f"epoch {epoch + 1}/{config.epochs}")
    error_sum, pixel_sum = sums.tolist()
    if not math.isfinite(error_sum):
        raise InputError(
            f"{training.reader.path}: the loss is not finite in epoch {epoch + 1}; lower --lr or check the images' units."
        )
    return mean_over_ranks(error_sum, pixel_sum, ranks, device)


def _errors(training: Training, batch: Batch, brightness: float, keys: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Sums over a batch: what is to be minimised, and the squared errors."""
    predictor, radiometry = training.predictor, training.radiometry
    maps = predictor.maps
    with torch.autocast(
        training.device.type, torch.bfloat16, enabled=training.precision == "bf16" and keys is not None
    ):
        shifted = predictor.shifted(batch.observation.elevation, keys)
    crops = len(shifted)
    rest = [value.expand(crops, 1, 1) for value in maps.everywhere().values()]
    frame = batch.observation.frame
    assert frame is not None

    def objective(first: int, last: int, shifted: Tensor, gain: Tensor, offset: Tensor, *rest: Tensor):
        coefficients = maps.combine(shifted, rest)
        rendered = form(batch.observation.part(first, last), maps.model, coefficients, training.extensions)
        measured = batch.image[first:last] / radiometry.scale
        predicted = rendered if radiometry.calibrated else gain * rendered + offset
        return crop_errors(predicted, measured, batch.valid[first:last], brightness)

    return sum_over_crops(objective, shifted, *radiometry.of_crops(frame), *rest)


@torch.no_grad()
def evaluate_loss(
    training: Training, indices: NDArray[np.int64], batch_size: int, brightness: float = 1.0
) -> tuple[float, float]:
    """Mean squared error and mean of what is minimised over the valid pixels of some pairs, in evaluation mode; NaN where
    there are none."""
    training.predictor.eval()
    totals, pixels = [0.0, 0.0], 0.0
    mine = indices[training.rank :: training.ranks]
    steps = [(mine[k : k + batch_size], None) for k in range(0, len(mine), batch_size)]
    for batch in prefetch(training.reader, steps, training.device):
        objective, error = _errors(training, batch, brightness)
        totals[0] += float(error)
        totals[1] += float(objective)
        pixels += float(batch.valid.sum())
    means = [mean_over_ranks(total, pixels, training.ranks, training.device) for total in totals]
    return means[0], means[1]


def check(config: Config) -> None:
    """Refuse options that cannot be. Raises ConfigError, RegistryError."""
    if config.epochs < 1 or config.batch < 1:
        raise ConfigError(f"--epochs and --batch: expected at least 1, found {config.epochs} and {config.batch}.")
    if not (math.isfinite(config.lr) and 0 < config.lr < 1):
        raise ConfigError(f"--lr: expected a number between 0 and 1, found {config.lr}.")
    if config.schedule not in ("constant", "cosine"):
        raise ConfigError(f"--schedule: expected 'constant' or 'cosine', found '{config.schedule}'.")
    if config.precision not in ("auto", "fp32", "bf16"):
        raise ConfigError(f"--precision: expected auto, fp32 or bf16, found '{config.precision}'.")
    if not 2 <= len(config.widths) <= DEEPEST or not 1 <= min(config.widths) <= max(config.widths) <= WIDEST:
        raise ConfigError(
            f"--widths: expected 2 .. {DEEPEST} stages of 1 .. {WIDEST} channels, found {'-'.join(map(str, config.widths))}."
        )
    if not 0 <= config.brightness <= 1:
        raise ConfigError(f"--brightness: expected a number from 0 to 1, found {config.brightness}.")
    if not config.dropout or not all(0 <= share < 1 for share in config.dropout):
        raise ConfigError(f"--dropout: expected shares from 0 to below 1, found {config.dropout}.")
    model = get_model(config.model)
    model.choose_maps(config.maps)
    if config.positive and not model.linear:
        raise ConfigError(f"--positive: expected a model that is linear in its coefficients, found '{model.name}'.")
    choose_device(config.device)


def _check_pairs(pairs: Path, reader: PairReader, config: Config, say: Say) -> None:
    train, validation = reader.indices("train"), reader.indices("validation")
    if not len(train):
        raise InputError(
            f"{pairs}:/split: expected training pairs (split = 0), found none; sample more crops or other tiles."
        )
    if not len(validation):
        say(f"no validation pairs in {pairs}: the epoch with the least training loss is kept")
    for what, part in (("training", train), ("validation", validation)):
        if len(part) and not any(reader.valid(part[k : k + 1]).any() for k in range(len(part))):
            raise InputError(f"{pairs}: no {what} pair has a valid pixel; sample more crops or other tiles.")
    stride = 2 ** (len(config.widths) - 1)
    if any(s % stride for s in reader.size):
        raise ConfigError(
            f"{pairs}: expected crops of a multiple of {stride} px for {len(config.widths)} widths, found {reader.size[0]} x {reader.size[1]}."
        )


def _introduction(training: Training) -> str:
    predictor, reader = training.predictor, training.reader
    maps = predictor.maps
    where = f"maps of {', '.join(maps.maps)}" + (f", global {', '.join(maps.rest)}" if maps.rest else "")
    weights = sum(p.numel() for p in predictor.net.parameters())
    train, validation = (len(reader.indices(part)) for part in ("train", "validation"))
    processes = f", {training.ranks} processes" if training.ranks > 1 else ""
    return (
        f"model {predictor.model.name}: {where}; {weights:,} weights, {train} training and {validation} validation pairs, "
        f"{training.device}, {training.precision}{processes}"
    )


def _load_extensions(path: str | None, pairs: Path, say: Say) -> list[Extension]:
    if path is None:
        return []
    from stages.effects import load_extension
    from stages.effects.extension import check_ground

    for note in check_ground(Path(path), pairs):
        say(f"note: {note}")
    return list(load_extension(Path(path)))


def _take(training: Training, state: dict[str, Tensor]) -> None:
    """Go back to a snapshot."""
    for name, module in (("predictor", training.predictor), ("radiometry", training.radiometry)):
        module.load_state_dict({k.split("/", 1)[1]: v for k, v in state.items() if k.startswith(f"{name}/")})


def _write_checkpoint(output: Path, config: Config, training: Training, history: History, overwrite: bool) -> None:
    """The weights and all that is needed to use them."""
    reader, predictor, radiometry = training.reader, training.predictor, training.radiometry
    trained = set(reader.frame[reader.indices("train")].tolist())
    known = np.array([k in trained or reader.units == "iof" for k in range(len(reader.image_ids))])
    maps = predictor.maps
    attributes: dict[str, Any] = {
        "model": predictor.model.name,
        "coefficients": json.dumps(maps.names),
        "maps": json.dumps(maps.maps),
        "globals": json.dumps({name: value.item() for name, value in maps.everywhere().items()}),
        "positive": np.int32(maps.positive),
        "deviations": np.int32(maps.channels > len(maps.maps)),
        "elevation_scale_m": predictor.elevation_scale,
        "output_scale": maps.output_scale,
        "gsd_m": reader.gsd,
        "body_radius_m": reader.body_radius,
        "image_units": reader.units,
        "best_epoch": np.int32(history.best_epoch),
        "start": json.dumps(training.start),
        "precision": training.precision,
    }
    if math.isfinite(predictor.image_noise):
        attributes["image_noise"] = predictor.image_noise
    sizes = {"epoch": len(history.train_loss), "frame": len(reader.image_ids)}
    with ArtefactWriter(
        output,
        CHECKPOINT,
        sizes,
        config=asdict(config),
        inputs=[reader.path],
        seed=config.seed,
        attributes=attributes,
        overwrite=overwrite,
    ) as writer:
        for key in ("train_loss", "validation_loss", "epoch_seconds"):
            writer.write(key, np.array(getattr(history, key)))
        writer.write("image_id", reader.image_ids)
        # An image without training pairs has no gain of its own: NaN says so.
        for key in ("gain", "offset"):
            writer.write(key, np.where(known, getattr(radiometry, key)().detach().cpu().numpy(), np.nan))
        write_state(writer.file.create_group("weights", track_order=True), predictor.state_dict())
