"""One pass over the pairs, in training or in validation."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from schemas import InputError
from stages.common.progress import Progress, show_nothing
from stages.train.config import Config
from stages.train.processes import mean_over_ranks, share_buffers, sum_over_ranks
from stages.train.steps import learning_rate, order_steps, prefetch
from stages.train.training import Training

CHECK_EVERY = 16  # batches: reading the loss makes a GPU wait
BACKWARD = 3  # time of a training step over that of a validation step, for the progress


def learn_epoch(
    training: Training, train: NDArray[np.int64], config: Config, epoch: int, progress: Progress = show_nothing
) -> float:
    """One pass over the training pairs; returns their mean squared error. Raises InputError where it is not finite.

    train : (n,), indices of pairs
    """
    rank, ranks, device = training.rank, training.ranks, training.device
    # All randomness of an epoch depends on (seed, epoch): a resumed run draws what an uninterrupted one would.
    rng = np.random.default_rng([config.seed, epoch])
    torch.manual_seed(hash((config.seed, epoch, rank)) % 2**31)
    training.predictor.train()
    sums = torch.zeros(2, dtype=torch.float64, device=device)  # squared errors and pixels of this process
    steps = order_steps(train, config.batch, config.augment, rng, rank, ranks)
    for number, batch in enumerate(prefetch(training.reader, steps, device)):
        for group in training.optimizer.param_groups:
            group["lr"] = learning_rate(
                config.lr, config.schedule, epoch * len(steps) + number, config.epochs * len(steps)
            )
        objective, error = training.errors(batch, config.brightness, training.precision == "bf16")
        pixels = batch.valid.sum().double()
        sums += torch.stack([error.detach().double(), pixels])
        if number % CHECK_EVERY == 0 and not torch.isfinite(sums[0]):
            break
        # The mean over the valid pixels of the whole batch. This process has its share of the sum, and DDP takes the
        # mean of the processes' gradients.
        loss = objective * ranks / sum_over_ranks(pixels, ranks).clamp(min=1).float()
        training.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        training.optimizer.step()
        if rank == 0:
            progress(number + 1, len(steps), f"epoch {epoch + 1}/{config.epochs}")
    error_sum, pixel_sum = sums.tolist()
    if not math.isfinite(error_sum):
        raise InputError(
            f"{training.reader.path}: the loss is not finite in epoch {epoch + 1}; lower `lr` or check the images' units."
        )
    return mean_over_ranks(error_sum, pixel_sum, ranks, device)


@torch.no_grad()
def evaluate_loss(
    training: Training,
    indices: NDArray[np.int64],
    batch_size: int,
    brightness: float = 1.0,
    progress: Progress = show_nothing,
) -> tuple[float, float]:
    """Mean squared error, and mean of what is minimised, over the valid pixels of some pairs, in evaluation mode.

    indices : (n,), of pairs; returns NaN where there are none
    """
    share_buffers(training.predictor, training.ranks)
    training.predictor.eval()
    totals, pixels = [0.0, 0.0], 0.0
    mine = indices[training.rank :: training.ranks]
    steps = [(mine[k : k + batch_size], None) for k in range(0, len(mine), batch_size)]
    for number, batch in enumerate(prefetch(training.reader, steps, training.device)):
        objective, error = training.errors(batch, brightness)
        totals[0] += float(error)
        totals[1] += float(objective)
        pixels += float(batch.valid.sum())
        if training.rank == 0:
            progress(number + 1, len(steps), "validation")
    means = [mean_over_ranks(total, pixels, training.ranks, training.device) for total in totals]
    return means[0], means[1]


def overall(progress: Progress, epoch: int, epochs: int, work: tuple[int, int], before: int = 0) -> Progress:
    """What a part of an epoch reports its progress to, as a share of the whole training and of what follows it.

    work : of training and of validation in an epoch; before : done in this epoch already
    """
    first, total = epoch * sum(work) + before, whole(epochs, work)
    each = 1 if before else BACKWARD
    return lambda done, _, what: progress(first + each * done, total, what)


def whole(epochs: int, work: tuple[int, int]) -> int:
    """All work: the epochs, then the standard deviations, which look once more at the training pairs."""
    return epochs * sum(work) + work[0] // BACKWARD
