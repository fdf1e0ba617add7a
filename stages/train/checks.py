"""Checks of the settings and of the pairs, before training begins."""

from __future__ import annotations

from schemas import ConfigError, InputError
from stages.common.progress import Say
from stages.network.checkpoint_layout import DEEPEST, WIDEST, are_dropouts, are_widths
from stages.network.precision import check_precision
from stages.network.predictor import choose_device
from stages.pairs.reader import PairReader
from stages.train.config import Config


def check(config: Config) -> None:
    """Refuse options that cannot be. Raises ConfigError, RegistryError."""
    config.check()
    check_precision(config.precision)
    if not are_widths(config.widths):
        raise ConfigError(
            f"`widths`: expected 2 .. {DEEPEST} stages of 1 .. {WIDEST} channels, found {'-'.join(map(str, config.widths))}."
        )
    if not are_dropouts(config.dropout):
        raise ConfigError(f"`dropout`: expected shares from 0 to below 1, found {config.dropout}.")
    if len(config.dropout) not in (1, len(config.widths)):
        raise ConfigError(
            f"`dropout`: expected one share, or {len(config.widths)} for as many `widths`, found {len(config.dropout)}."
        )
    choose_device(config.device)


def check_pairs(reader: PairReader, config: Config, say: Say) -> None:
    """Refuse pairs that cannot be learned from. Raises InputError, ConfigError."""
    pairs = reader.path
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
