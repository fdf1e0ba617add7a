"""train: a U-Net that predicts reflectance from terrain, learned through the differentiable formation chain.

Read from top to bottom: set up, one loop over epochs; `epoch.py` has the loop over batches. Several processes (``torchrun``)
share every batch; the first one writes.
"""

from __future__ import annotations

import json
import math
import os
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
import torch.distributed as dist

from schemas.files.outputs import Output
from schemas.provenance import sha256
from stages.common.memory import keep_freed_memory
from stages.common.progress import Progress, Say
from stages.network.predictor import choose_device
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Extension
from stages.train.checkpoint import write_checkpoint
from stages.train.checks import check, check_pairs
from stages.train.config import Config, state_path
from stages.train.deviations import fit_deviations
from stages.train.epoch import BACKWARD, evaluate_loss, learn_epoch, overall, whole
from stages.train.processes import join_group
from stages.train.resume import History, Weights, copy_weights, load_weights, restore, save
from stages.train.training import describe, error_unit, set_up


@dataclass(frozen=True)
class Summary:
    """What training reached."""

    history: History
    pairs_per_second: float
    precision: str
    start: dict[str, float]
    error_unit: str


def work(pairs: Path, output: Output, config: Config, say: Say, progress: Progress) -> Summary:
    """See :func:`stages.train.run`."""
    check(config)
    sidecar = state_path(output)
    rank, ranks = join_group()
    device = choose_device(config.device)
    if device.type == "cuda" and ranks > 1:
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
    keep_freed_memory()
    extensions = _load_extensions(config.extend, pairs, say)
    if extensions and config.augment:
        # an effect may depend on a direction on the ground, which is lost when crops are turned
        say("crops are not turned or mirrored: the extended model may hold effects bound to an azimuth")
        config = replace(config, augment=False)
    with PairReader(pairs, detector=bool(extensions)) as reader:
        check_pairs(reader, config, say)
        training = set_up(reader, config, extensions, device, rank, ranks)
        history, best = History(), Weights()
        # A constant rate may go on for more epochs than before; a cosine's first epochs already depend on their number.
        epochs = config.epochs if config.schedule == "cosine" else None
        identity = json.dumps(
            asdict(config) | {"device": None, "epochs": epochs, "pairs": sha256(pairs), "ranks": ranks}, sort_keys=True
        )
        if output.resume and sidecar.exists():
            history, best = restore(sidecar, identity, training)
            say(f"resumed after epoch {len(history.train_loss)}/{config.epochs}")
        if rank == 0:
            say(describe(training))
        speed, unit = math.nan, error_unit(training)
        train, validation = reader.indices("train"), reader.indices("validation")
        work = BACKWARD * math.ceil(len(train) / config.batch), math.ceil(len(validation[rank::ranks]) / config.batch)
        for epoch in range(len(history.train_loss), config.epochs):
            began = time.monotonic()
            train_loss = learn_epoch(training, train, config, epoch, overall(progress, epoch, config.epochs, work))
            training_seconds = time.monotonic() - began
            shown = overall(progress, epoch, config.epochs, work, work[0])
            validation_loss, objective = evaluate_loss(training, validation, config.batch, config.brightness, shown)
            history.train_loss.append(train_loss)
            history.validation_loss.append(validation_loss)
            # the least objective, not error, is the best: the brightness of a few crops would choose by chance
            history.objective.append(objective if math.isfinite(objective) else train_loss)
            history.epoch_seconds.append(time.monotonic() - began)
            if history.objective[-1] <= min(history.objective):
                history.best_epoch = epoch
                best = copy_weights(training)
            if rank == 0:
                save(sidecar, identity, training, history, best)
                speed = len(train) / training_seconds
                say(
                    f"epoch {epoch + 1:3d}/{config.epochs}  RMSE in {unit}: training {math.sqrt(train_loss):.5f}, "
                    f"validation {math.sqrt(validation_loss):.5f}{' *' if history.best_epoch == epoch else '  '} {speed:6.1f} pairs/s"
                )
        if rank == 0:
            load_weights(training, best)
            fit_deviations(training, train, validation)
            progress(whole(config.epochs, work), whole(config.epochs, work), "standard deviations")
            write_checkpoint(output, config, training, history)
            sidecar.unlink(missing_ok=True)
    if ranks > 1:
        dist.barrier()
        dist.destroy_process_group()
    return Summary(history, speed, training.precision, training.start, unit)


def _load_extensions(path: str | None, pairs: Path, say: Say) -> list[Extension]:
    if path is None:
        return []
    from stages.effects import load_extension
    from stages.effects.extension import check_ground

    for note in check_ground(Path(path), pairs):
        say(f"note: {note}")
    return list(load_extension(Path(path)))
