"""What every step of training works with: network, radiometry and optimizer, set up for the first step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from stages.common.brightness import NAMES
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.losses import Radiometry, crop_errors
from stages.network.precision import choose_precision
from stages.network.predictor import Predictor
from stages.network.unet import UNet
from stages.pairs.reader import Batch, PairReader
from stages.physics.formation.chain import Extension, form
from stages.physics.photometry import get_model
from stages.train.config import Config
from stages.train.start import elevation_scale, fit_start


class Errors(nn.Module):
    """What training minimises, with all learned parameters in one module, as DistributedDataParallel needs it."""

    def __init__(self, predictor: Predictor, radiometry: Radiometry, extensions: list[Extension]) -> None:
        super().__init__()
        self.predictor, self.radiometry, self.extensions = predictor, radiometry, extensions

    def forward(self, batch: Batch, brightness: float, bf16: bool = False) -> tuple[Tensor, Tensor]:
        """Sums over a batch, () each: what is minimised, and squared errors. brightness : see ``Config``"""
        maps, observation = self.predictor.maps, batch.observation
        with torch.autocast(observation.elevation.device.type, torch.bfloat16, enabled=bf16):
            unbounded = self.predictor.unbounded(observation.elevation)
        rendered = form(observation, maps.model, maps.combine(unbounded), self.extensions)
        if not self.radiometry.calibrated:
            assert observation.frame is not None
            gain, offset = self.radiometry.crop_gains(observation.frame)
            rendered = gain * rendered + offset
        return crop_errors(rendered, batch.image / self.radiometry.scale, batch.valid, brightness)


@dataclass
class Training:
    """What every step of training works with and changes.

    errors : gives what training minimises; its gradients are the means over all processes
    start : the uniform surface that training begins at, by coefficient; rank, ranks : this process among those that
    share every batch
    """

    reader: PairReader
    predictor: Predictor
    radiometry: Radiometry
    errors: nn.Module
    optimizer: torch.optim.Optimizer
    extensions: list[Extension]
    device: torch.device
    precision: str
    start: dict[str, float]
    rank: int = 0
    ranks: int = 1

    @property
    def modules(self) -> dict[str, nn.Module]:
        """All that has weights, by the names that files give them."""
        return {"predictor": self.predictor, "radiometry": self.radiometry}

    @property
    def learned(self) -> list[Tensor]:
        """All tensors that the optimizer changes."""
        return [p for group in self.optimizer.param_groups for p in group["params"]]


def set_up(
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
    if ranks > 1 and device.type == "cuda":  # PyTorch has none for CPUs: each process normalises by its share there
        predictor.net = nn.SyncBatchNorm.convert_sync_batchnorm(net)
    predictor.to(device)
    predictor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    radiometry.to(device)
    learned = [p for p in (*predictor.parameters(), *radiometry.parameters()) if p.requires_grad]
    optimizer = torch.optim.Adam(learned, lr=config.lr, fused=True)
    precision = choose_precision(device) if config.precision == "auto" else config.precision
    named = dict(zip((p.name for p in model.parameters), start.tolist(), strict=True))
    errors: nn.Module = Errors(predictor, radiometry, extensions)
    if ranks > 1:
        errors = nn.parallel.DistributedDataParallel(errors, broadcast_buffers=False)
    return Training(reader, predictor, radiometry, errors, optimizer, extensions, device, precision, named, rank, ranks)


def error_unit(training: Training) -> str:
    """What root mean squared errors are in: of uncalibrated images gains are fitted, so that errors read like I/F."""
    return NAMES["iof"] if training.radiometry.calibrated else f"{NAMES['dn']} (at the images' mean gain)"


def describe(training: Training) -> str:
    """A line on what is about to be learned, on which machine."""
    predictor, reader = training.predictor, training.reader
    maps = predictor.maps
    where = f"maps of {', '.join(maps.maps)}" + (
        f", global {', '.join(maps.global_names)}" if maps.global_names else ""
    )
    weights = sum(p.numel() for p in predictor.net.parameters())
    train, validation = (len(reader.indices(part)) for part in ("train", "validation"))
    processes = f", {training.ranks} processes" if training.ranks > 1 else ""
    return (
        f"model {predictor.model.name}: {where}; {weights:,} weights, {train} training and {validation} validation pairs, "
        f"{training.device}, {training.precision}{processes}"
    )
